"""``python -m crptpro``: the command line where ``crptpro`` is not on the PATH."""

from crptpro.cli import main

if __name__ == "__main__":
    main()
