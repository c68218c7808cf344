"""CRPTpro: cross-domain random pre-training with prototypes for reinforcement learning from pixels."""

__version__ = "0.1.0"
