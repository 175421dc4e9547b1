"""What is promised is written down, and what changes in it is in the changelog."""

from tests import public_api


def test_the_page_of_public_names_is_current():
    assert public_api.PAGE.read_text(encoding="utf-8") == public_api.page(), f"run {public_api.AGAIN}"


def test_what_changed_is_in_the_changelog():
    changed = ", ".join(public_api.unmentioned())
    assert not changed, f"the newest section of CHANGELOG.md should say what changed, in backticks: {changed}"


def test_a_patch_version_keeps_its_promise():
    assert public_api.broken() == []


def test_a_promise_that_a_patch_version_breaks_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(public_api, "RELEASED", tmp_path / "released.json")
    (tmp_path / "released.json").write_text('{"kept": "same", "changed": "old", "gone": "old"}')
    monkeypatch.setattr(public_api, "digests", lambda: {"kept": "same", "changed": "new", "added": "new"})
    for version, names in (("0.2.1", ["changed", "gone"]), ("0.2.0", [])):
        monkeypatch.setattr("gsjax.__version__", version)
        assert public_api.broken() == names


def test_a_change_that_is_not_in_the_changelog_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(public_api, "ROOT", tmp_path)
    monkeypatch.setattr(public_api, "RELEASED", tmp_path / "released.json")
    (tmp_path / "released.json").write_text('{"kept": "same", "changed": "old", "gone": "old"}')
    now = {"kept": "same", "changed": "new", "added": "new"}
    monkeypatch.setattr(public_api, "digests", lambda: now)
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text(
        "# Changelog\n\n## [Unreleased]\n\nMuch.\n\n## 0.1.0\n\n`changed`, `gone` and `added`\n"
    )
    assert public_api.unmentioned() == ["added", "changed", "gone"]
    changelog.write_text("# Changelog\n\n## [Unreleased]\n\n`gsjax.changed(x)` for `gone`; `added`\n")
    assert public_api.unmentioned() == []
