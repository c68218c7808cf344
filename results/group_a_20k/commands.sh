#!/usr/bin/env bash
# Every command of this run, in order; each can be killed and repeated. OMP_NUM_THREADS=1 because two of them ran at
# a time on two cores; collection used both.
set -euo pipefail
export OMP_NUM_THREADS=1

crptpro collect A --transitions 20000 --out data --seed 0 --workers 2
crptpro pretrain data/cheetah data/walker data/quadruped --out runs/group_a --updates 3000 --batch-size 512 --seed 0 \
  --log-interval 20 --checkpoint-interval 250

for task in walker_run cheetah_run; do
  for pretrained in random-encoder runs/group_a/encoder; do
    name=$([ "$pretrained" = random-encoder ] && echo random || echo crptpro)
    crptpro downstream "$task" --pretrained "$pretrained" --out "runs/${task}_$name" --env-steps 30000 \
      --batch-size 128 --learning-rate 1e-3 --replay-capacity 15000 --eval-interval-env-steps 10000 \
      --checkpoint-interval-env-steps 5000 --seed 0
  done
  crptpro evaluate random-policy --task "$task" --episodes 10 --seed 0 --csv "runs/${task}_uniform.csv"
done
# The figures were drawn by figures.py of that revision (git log -- results/group_a_20k/figures.py).
