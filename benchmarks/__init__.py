"""Scripts that measure, each run as ``python -m benchmarks.<name>`` from the root of the repository."""

import crptpro  # noqa: F401  # before tensordict: torch asks once whether it may use huge pages, and crptpro says yes
