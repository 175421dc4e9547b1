"""Parses JSON and YAML that may have been edited: any fault is a ValueError with a short message."""

import json
from collections.abc import Callable
from typing import Any

import yaml

from gsjax.io.brief import brief


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Args:
        text: the JSON.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or has a number with too many digits; the message
            says so, and does not name the file.
    """
    return _parsed(json.loads, text)


def parse_yaml(text: str | bytes) -> Any:
    """The value of a YAML text; only plain values are constructed.

    Args:
        text: the YAML.

    Raises:
        ValueError: as for `parse_json`, or a date does not exist.
    """
    return _parsed(yaml.safe_load, text)


def _parsed(parse: Callable[[str | bytes], Any], text: str | bytes) -> Any:
    try:
        return parse(text)
    except RecursionError as error:
        raise ValueError("values that are nested too deep") from error
    except (ValueError, OverflowError, yaml.YAMLError) as error:
        raise ValueError(brief(error)) from error
