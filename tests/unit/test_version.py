"""The version names the commit, so that two checkouts can be told apart."""

import subprocess

from service import __version__, version


def git(root, *words):
    subprocess.run(["git", "-C", str(root), *words], check=True, capture_output=True)


def test_a_checkout_is_described_by_its_commit_and_by_whether_files_differ(tmp_path):
    git(tmp_path, "init")
    (tmp_path / "a.py").write_text("1\n")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-m", "first")
    commit = version.describe_checkout(tmp_path)
    assert len(commit) >= 7
    assert int(commit, 16)
    (tmp_path / "a.py").write_text("2\n")
    assert version.describe_checkout(tmp_path) == f"{commit}-modified"


def test_a_folder_without_git_has_no_commit(tmp_path):
    assert version.describe_checkout(tmp_path) == ""


def test_a_broken_checkout_has_no_commit(tmp_path):
    (tmp_path / ".git").write_text("gitdir: nowhere\n")
    assert version.describe_checkout(tmp_path) == ""


def test_the_commit_of_the_build_is_used_where_git_has_no_checkout(tmp_path, monkeypatch):
    (tmp_path / "commit.txt").write_text("0123abcd-modified\n")
    monkeypatch.setattr(version, "COMMIT_FILE", tmp_path / "commit.txt")
    monkeypatch.setattr(version, "describe_checkout", lambda _: "")
    assert version.software_version.__wrapped__() == f"{__version__}+0123abcd.modified"
