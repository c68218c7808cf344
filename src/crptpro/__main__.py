"""``python -m crptpro``: the command where it is not on the path."""

from crptpro.cli import main

if __name__ == "__main__":
    main()
