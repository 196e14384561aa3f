"""``python -m torchvts`` is the command ``torchvts``."""

import sys

from .cli import main

sys.exit(main())
