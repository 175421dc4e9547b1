"""The page of public names is current, and the changelog mentions every change to them."""

import json

import pytest

from tests import public_api


def test_the_page_of_public_names_is_current():
    assert public_api.PAGE.read_text(encoding="utf-8") == public_api.page(), f"run {public_api.AGAIN}"


def test_what_changed_is_in_the_changelog():
    changed = ", ".join(public_api.unmentioned())
    assert not changed, f"the newest section of CHANGELOG.md should say what changed, in backticks: {changed}"


def test_a_patch_version_keeps_its_promise():
    assert public_api.broken() == []


BEFORE = {
    "kept": {"": "same"},
    "changed": {"": "old"},
    "gone": {"": "old"},
    "Config": {"": "same", "kept": "same", "changed": "old", "gone": "old"},
}
NOW = {
    "kept": {"": "same"},
    "changed": {"": "new"},
    "added": {"": "new"},
    "Config": {"": "same", "kept": "same", "changed": "new", "added": "new"},
}


@pytest.fixture
def released(tmp_path, monkeypatch):
    monkeypatch.setattr(public_api, "RELEASED", tmp_path / "released.json")
    (tmp_path / "released.json").write_text(json.dumps(BEFORE))
    monkeypatch.setattr(public_api, "digests", lambda: NOW)


@pytest.mark.usefixtures("released")
def test_a_promise_that_a_patch_version_breaks_is_found(monkeypatch):
    monkeypatch.setattr("gsjax.__version__", "0.2.1")
    broken = ["Config.changed", "Config.gone", "Config.added", "changed", "gone"]
    assert public_api.broken() == broken
    monkeypatch.setattr("gsjax.__version__", "0.2.0")
    assert public_api.broken() == []


@pytest.mark.usefixtures("released")
def test_a_change_that_is_not_in_the_changelog_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(public_api, "ROOT", tmp_path)
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text(
        "# Changelog\n\n## [Unreleased]\n\nMuch.\n\n## 0.1.0\n\n`changed`, `gone` and `added`\n"
    )
    assert public_api.unmentioned() == [
        "Config.changed",
        "Config.gone",
        "Config.added",
        "added",
        "changed",
        "gone",
    ]
    changelog.write_text("# Changelog\n\n## [Unreleased]\n\n`gsjax.changed(x)` for `gone`; `added`\n")
    assert public_api.unmentioned() == ["Config.changed", "Config.gone", "Config.added"]
    changelog.write_text(changelog.read_text() + "\nA `Config` has `added` for `gone`; `changed`, too.\n")
    assert public_api.unmentioned() == []


def test_a_member_is_known_with_what_decorates_it():
    lines = ["class A:", "    size: int = 3", "    @property", "    def first(self) -> int: ..."]
    before = public_api._digests(lines)
    assert set(before) == {"", "size", "first"}
    after = public_api._digests([*lines[:2], lines[3]])
    assert [member for member in before if before[member] != after[member]] == ["first"]
