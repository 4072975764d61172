"""Complete steps are kept, changed steps are repeated, and interrupted steps continue."""

from __future__ import annotations

import pytest

from neilfpp_method.prepare.steps import begin, stamp


def test_a_step_is_incomplete_until_it_is_marked(tmp_path):
    step = begin(tmp_path / "a", size=3)
    assert step.result is None
    (step.folder / "half").write_text("done")
    again = begin(tmp_path / "a", size=3)
    assert again.result is None
    assert (again.folder / "half").is_file()  # an interrupted step keeps its files
    again.complete({"count": 7})
    assert begin(tmp_path / "a", size=3).result == {"count": 7}


def test_other_inputs_start_with_an_empty_folder(tmp_path):
    step = begin(tmp_path / "a", size=3)
    (step.folder / "old").write_text("old")
    step.complete({})
    fresh = begin(tmp_path / "a", size=4)
    assert fresh.result is None
    assert not (fresh.folder / "old").exists()


def test_a_folder_that_is_half_emptied_is_not_complete(tmp_path, monkeypatch):
    step = begin(tmp_path / "a", size=3)
    (step.folder / "file").write_text("of size 3")
    step.complete({})

    def killed(folder):
        (folder / "file").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("neilfpp_method.prepare.steps.shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            begin(tmp_path / "a", size=4)
    assert begin(tmp_path / "a", size=3).result is None


def test_a_change_repeats_all_later_steps(tmp_path):
    for size, known in ((3, None), (3, {}), (4, None)):
        first = begin(tmp_path / "a", size=size)
        first.complete({})
        second = begin(tmp_path / "b", first, way="same")
        assert second.result == known
        second.complete({})


def test_a_step_with_a_damaged_marker_is_repeated(tmp_path):
    step = begin(tmp_path / "a")
    step.complete({})
    for text in ("", "[]", "{", "[" * 100_000):
        (step.folder / "step.json").write_text(text)
        assert begin(tmp_path / "a").result is None


def test_a_file_that_changes_has_another_stamp(tmp_path):
    path = tmp_path / "image.png"
    path.write_bytes(b"one")
    before = stamp([path], tmp_path)
    assert before[0][:2] == ["image.png", 3]
    assert stamp([path], tmp_path) == before
    path.write_bytes(b"three")
    assert stamp([path], tmp_path) != before
