"""Lists of names in messages."""

from gsjax.io.brief import shortened


def test_a_list_of_names_is_short():
    assert shortened(["a", "b"]) == "a, b"
    assert shortened("abcde", 2) == "a, b, ..."
    endless = shortened(["x" * 30_000, "y"])
    assert len(endless) < 300
    assert endless.startswith("xxx")
    assert endless.endswith(", y")
