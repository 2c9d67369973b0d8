"""The table of messages holds what the package raises."""

import messages


def test_messages_are_read_with_their_class_place_and_words(tmp_path, monkeypatch):
    monkeypatch.setattr(messages, "PACKAGE", tmp_path / "torchrg")
    (tmp_path / "torchrg").mkdir()
    (tmp_path / "torchrg" / "a.py").write_text(
        "raise FormatError(f'{path}: expected '\n    f'{n:,} points, ' 'got none.') from error\n"
        "raise\n"
        "warnings.warn(text, stacklevel=2)\n"
    )
    assert messages.table().splitlines()[2:] == [
        "| torchrg/a.py:1 | FormatError | {path}: expected {n} points, got none. |",
        "| torchrg/a.py:4 | warnings.warn | {text} |",
    ]


def test_every_refusal_of_the_package_is_listed():
    rows = messages.table().splitlines()[2:]
    assert len(rows) > 300
    assert any("file not found; check the path." in row for row in rows)
