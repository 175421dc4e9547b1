"""`python -m benchmarks` is `gsjax bench`."""

import sys

from gsjax.cli import main

sys.exit(main(["bench", *sys.argv[1:]]))
