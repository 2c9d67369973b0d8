"""A folder as the disk may hold it after the power has gone: what was not flushed may be lost."""

import json
import os
import shutil
from itertools import zip_longest
from pathlib import Path

PAGE = 4096
_replace = os.replace  # Tests replace it.


class PowerCutError(BaseException):
    """Ends everything: no handler of errors takes it."""


class Disk:
    """A folder, and what of it has been flushed.

    Put :meth:`fsync` in the place of ``os.fsync``. What it has seen is kept in another folder, so
    that any process can ask what is left. A page of a file that was not flushed since it was
    written is either as it was, or written, or zero; a name that was not flushed either there or
    not. Chance decides for each.
    """

    def __init__(self, root, kept):
        self.root, self.kept = root, kept

    def settle(self):
        """Take everything as flushed."""
        shutil.rmtree(self.kept, ignore_errors=True)
        for part in ("names", "content", "inodes"):
            (self.kept / part).mkdir(parents=True)
        for folder, _, names in os.walk(self.root):
            self._keep_names(Path(folder))
            for name in names:
                self._keep_content(Path(folder, name))

    def fsync(self, descriptor):
        """Keep what a file holds now, or which names a folder does."""
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        if path.is_relative_to(self.root) and path.exists():
            self._keep_names(path) if path.is_dir() else self._keep_content(path)

    def _keep_content(self, path):
        inode = str(path.stat().st_ino)
        # With a second name the number is not given to another file.
        if not (self.kept / "inodes" / inode).exists():
            os.link(path, self.kept / "inodes" / inode)
        self._put(self.kept / "content" / inode, path.read_bytes())

    def _keep_names(self, folder):
        self._put(self._place_of(folder), json.dumps(_entries(folder)).encode())

    def _place_of(self, folder):
        parts = folder.relative_to(self.root).parts
        return self.kept / "names" / "|".join(["root", *parts])

    def _put(self, path, content):
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        temporary.write_bytes(content)
        _replace(temporary, path)

    def _names(self, folder):
        try:
            return json.loads(self._place_of(folder).read_bytes())
        except FileNotFoundError:
            return {}

    def _content(self, inode):
        try:
            return (self.kept / "content" / str(inode)).read_bytes()
        except FileNotFoundError:
            return b""

    def cut(self, after, rng):
        """Write to a folder what is left if the power goes now."""
        shutil.rmtree(after, ignore_errors=True)
        self._cut(self.root, after, rng, rng.choice([0.0, 0.5, 0.9]))

    def _cut(self, folder, after, rng, fraction):
        after.mkdir()
        flushed = self._names(folder)
        # A folder that was removed holds nothing now, but may have come back with what it held.
        written = _entries(folder) if folder.is_dir() else {}
        for name in sorted({*flushed, *written}):
            is_written = rng.random() < fraction
            entry = (written if is_written else flushed).get(name)
            path = folder / name
            if entry is None:
                continue
            inode, is_folder = entry
            if is_folder:
                self._cut(path, after / name, rng, fraction)
            elif entry != written.get(name):
                (after / name).write_bytes(self._content(inode))
            else:
                content = _lose(self._content(inode), path.read_bytes(), rng, fraction)
                (after / name).write_bytes(content)

    def restore(self, after):
        """Let the folder be what was left."""
        shutil.rmtree(self.root)
        after.rename(self.root)
        self.settle()


def _entries(folder):
    """Return for each name in a folder the number of its file, and whether it is a folder."""
    return {path.name: [path.lstat().st_ino, path.is_dir()] for path in folder.iterdir()}


def _lose(flushed, written, rng, fraction):
    """Return a file some of whose pages are as they were when it was flushed, or zero."""
    if flushed == written:
        return written
    size = len(rng.choice([flushed, written]))
    pages = []
    for old, new in zip_longest(_pages(flushed), _pages(written), fillvalue=b""):
        page = new if rng.random() < fraction else old
        pages.append(page.ljust(PAGE, b"\0"))
    return b"".join(pages)[:size].ljust(size, b"\0")


def _pages(content):
    return [content[start : start + PAGE] for start in range(0, len(content), PAGE)]
