"""`python -m wepose_pin`: the command ``wepose``."""

from .commands import main

if __name__ == "__main__":
    main()
