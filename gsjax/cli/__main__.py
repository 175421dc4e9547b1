"""`python -m gsjax.cli` is `gsjax`."""

import sys

from gsjax.cli import main

sys.exit(main())
