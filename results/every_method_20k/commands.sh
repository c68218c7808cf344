#!/usr/bin/env bash
# Every method of the comparison on the same small budget; run from the repository's root with the environment active.
# Each line can be killed and started again. Two ran at a time, with one thread each.
#   bash results/every_method_20k/commands.sh            prints the commands
#   bash results/every_method_20k/commands.sh apt-c      runs one
set -euo pipefail
OUT=${OUT:-runs/every_method}

# 60,000 random transitions (20,000 a domain) or 20,000 decisions of exploration; 3,000 encoder updates of batch 128.
COLLECT=(--group A --transitions 20000 --workers 2)
GROUP=(--group A --explore.env-steps 40000 --explore.random-agent-steps 667)
SINGLE=(--variant s --domain walker --explore.env-steps 40000 --explore.random-agent-steps 2000)
BATCH=(--pretrain-batch-size 128)
# As many prototypes as rows, as in the paper (512 of both): with more, most rows are their own nearest candidates and
# the prototype reward is 0.
PROTOTYPES=(--num-prototypes 128)
EVERY_6=(--explore.encoder-update-interval 6 --explore.checkpoint-interval-env-steps 2000)
EVERY_18=(--explore.encoder-update-interval 18 --explore.checkpoint-interval-env-steps 2000)
# 20,000 env steps of the same task.
task() { # prefix of the recipe's settings
    echo --"$1".env-steps 20000 --"$1".batch-size 128 --"$1".learning-rate 1e-3 --"$1".replay-capacity 12000 \
         --"$1".checkpoint-interval-env-steps 2000
}
DOWN="--tasks walker_stand $(task downstream)"

command_of() {
    case $1 in
        crptpro) echo crptpro.py --out "$OUT/random" "${COLLECT[@]}" --updates 3000 "${BATCH[@]}" "${PROTOTYPES[@]}" $DOWN ;;
        random-encoder) echo crptpro.py --out "$OUT/random" --pretrained random-encoder $DOWN ;;
        crptpro-finetune) echo finetune.py "$OUT/random/group_A_seed_0/encoder" --out "$OUT/random" --domain walker \
            --transitions 20000 --updates 500 --batch-size 128 --task walker_stand $(task downstream) ;;
        atc) echo atc.py --out "$OUT/random" "${COLLECT[@]}" --updates 3000 "${BATCH[@]}" $DOWN ;;
        proto-rl-c) echo proto_rl.py --out "$OUT/active" "${GROUP[@]}" "${EVERY_6[@]}" "${BATCH[@]}" "${PROTOTYPES[@]}" $DOWN ;;
        proto-rl-s) echo proto_rl.py --out "$OUT/active" "${SINGLE[@]}" "${EVERY_6[@]}" "${BATCH[@]}" "${PROTOTYPES[@]}" $DOWN ;;
        apt-c) echo apt.py --out "$OUT/active" "${GROUP[@]}" "${EVERY_6[@]}" "${BATCH[@]}" $DOWN ;;
        apt-s) echo apt.py --out "$OUT/active" "${SINGLE[@]}" "${EVERY_6[@]}" "${BATCH[@]}" $DOWN ;;
        # Three updates each time, so a third as often.
        becl) echo becl.py --out "$OUT/active" "${GROUP[@]}" "${EVERY_18[@]}" "${BATCH[@]}" $DOWN ;;
        drq) echo drq.py --out "$OUT/drq" --tasks walker_stand $(task drq) ;;
        *) echo "unknown method $1" >&2; return 1 ;;
    esac
}

METHODS="crptpro random-encoder atc proto-rl-s proto-rl-c becl apt-s apt-c crptpro-finetune drq"
if [ $# -eq 0 ]; then
    for method in $METHODS; do echo "python recipes/$(command_of "$method")"; done
else
    export OMP_NUM_THREADS=1
    exec python recipes/$(command_of "$1")
fi
