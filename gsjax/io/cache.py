"""The folder for files that are kept between runs and may be deleted at any time."""

from pathlib import Path

from platformdirs import user_cache_dir


def user_cache() -> Path | None:
    """The folder of gsjax in the user's cache; None for a user without a home, as in some containers."""
    try:
        folder = Path(user_cache_dir("gsjax", appauthor=False))
    except RuntimeError:
        return None
    return folder if folder.is_absolute() else None  # older platformdirs return "~/.cache" instead
