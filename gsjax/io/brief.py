"""Shortens what error messages quote from files and libraries: damaged files hold text of any length."""

from collections.abc import Iterable

_MOST, _NAME = 400, 200
_LEFT_OUT = " ... "


def brief(text: object, most: int = _MOST) -> str:
    """A text as one paragraph, without its middle if it is long.

    Args:
        text: what to quote, or an error of another library.
        most: number of characters to keep.
    """
    words = str(text)
    if len(words) > 4 * most:  # before splitting it
        words = words[: 2 * most] + _LEFT_OUT + words[-2 * most :]
    words = " ".join(words.split())
    if len(words) <= most:
        return words
    half = (most - len(_LEFT_OUT)) // 2
    return words[:half] + _LEFT_OUT + words[-half:]


def shortened(names: Iterable[str], most: int = 3) -> str:
    """Names joined for a message: only the first few if there are many, without the middle of very long ones.

    Args:
        names: the names.
        most: how many are listed.
    """
    names = list(names)
    return ", ".join(brief(name, _NAME) for name in names[:most]) + (", ..." if len(names) > most else "")
