from __future__ import annotations

# Looking for doctests would import this file once more, under a name that another conftest.py has too.
collect_ignore = ["conftest.py"]
