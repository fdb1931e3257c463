"""`python -m wepose_pin`: the command ``wepose``."""

from .cli import main

main()
