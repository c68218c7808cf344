from __future__ import annotations

# Looking for doctests would import this file once more, under a name that another conftest.py has too, and register
# the plugin's experiment in every process.
collect_ignore = ["conftest.py", "slow_env.py"]
