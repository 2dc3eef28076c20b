"""``python -m torchrl_l1.cli``."""

from torchrl_l1.cli import main

main()
