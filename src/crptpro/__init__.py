"""CRPTpro: cross-domain random pre-training with prototypes for reinforcement learning from pixels."""

import os

__version__ = "0.1.0"

# PyTorch asks for huge pages for large CPU tensors if this is set when it makes its first. What an update makes and
# frees is mapped anew every time, and page by page that was a tenth of its processor time. Linux alone has it; it
# changes no number; THP_MEM_ALLOC_ENABLE=0 turns it off.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
