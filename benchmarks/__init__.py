"""Scripts that measure, each run as ``python -m benchmarks.<name>`` from the root of the repository."""

import crptpro  # noqa: F401  # before torch: it sets what torch and OpenMP read once
