"""``python -m chargetune``."""

from chargetune.cli import main

if __name__ == "__main__":
    main()
