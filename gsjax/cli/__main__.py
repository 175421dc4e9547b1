"""`python -m gsjax.cli` is `gsjax`."""

from gsjax.cli import entry

entry()
