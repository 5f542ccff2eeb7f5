"""``python -m mgavatar``."""

from mgavatar.cli import main

if __name__ == "__main__":
    main()
