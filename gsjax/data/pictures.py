"""Picture formats: which are read, which are known but not read, and whether a file is complete."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path

from gsjax.data.errors import DataError, DataWarning
from gsjax.io.brief import shortened

SUFFIXES = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".tif", ".tiff", ".bmp", ".webp", ".avif")
"""File extensions of the pictures that all readers and commands take, in lower case."""

_CONVERT = (
    "Convert to JPEG or PNG first, for example with heif-convert or ImageMagick (magick mogrify -format "
    "jpg), and give the new files."
)
_DEVELOP = (
    "Develop to JPEG, PNG or TIFF first, for example with darktable-cli, RawTherapee or ImageMagick, and "
    "give the new files."
)
_OTHERS = {"HEIC": (".heic", ".heics", ".heif", ".heifs", ".hif"), "AVIF": (".avifs",)}
_OTHERS |= {"JPEG XL": (".jxl",), "JPEG 2000": (".jp2", ".j2k", ".jpx"), "GIF": (".gif",), "PSD": (".psd",)}
_RAW = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".rwl"),
    *(".pef", ".srw", ".3fr", ".fff", ".iiq", ".x3f", ".gpr", ".erf", ".kdc", ".dcr", ".mrw", ".mef", ".mos"),
)
_UNREAD = {suffix: (name, _CONVERT) for name, suffixes in _OTHERS.items() for suffix in suffixes}
_UNREAD |= dict.fromkeys(_RAW, ("camera raw", _DEVELOP))

# The first bytes of a file, whatever its name: phones and programs rename HEIC to .jpg.
_HEADS = {
    re.compile(rb"....ftyp(?:hei[cxms]|hev[cxms]|mif1|msf1)", re.DOTALL): ("HEIC", _CONVERT),
    re.compile(rb"....ftypavi[fs]", re.DOTALL): ("AVIF", _CONVERT),
    re.compile(rb"....JXL |\xff\x0a", re.DOTALL): ("JPEG XL", _CONVERT),
    re.compile(rb"....ftypcrx |FUJIFILMCCD-RAW|II\*\0\x10\0\0\0CR|FOVb|II(?:RO|RS|U\0)", re.DOTALL): (
        "camera raw",
        _DEVELOP,
    ),
}
_WEB = re.compile(rb"RIFF....WEBP|....ftypavi[fs]", re.DOTALL)
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_ENDS = {_JPEG: b"\xff\xd9", _PNG: b"IEND"}
_LARGE, _TAIL = 2**20, 2**16  # bytes; a thumbnail never lies at the end of a large file
_MARKER = re.compile(rb"\xff[^\x00\xff]")
_AFTER_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # neither a stuffed 0xff nor a restart marker
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9


def is_picture(path: Path) -> bool:
    """Whether a file name is that of a picture in a format that is read; hidden files do not count."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def is_unread(path: Path) -> bool:
    """Whether a file name is that of a picture in a format that is known but not read."""
    return path.suffix.lower() in _UNREAD and not path.name.startswith(".")


def unread_format(path: Path, head: bytes = b"") -> tuple[str, str] | None:
    """The format of a picture that is known but not read, and what to do about it; None for other formats.

    Args:
        path: the file, whose extension decides if its first bytes do not.
        head: its first bytes, if known.
    """
    if head.startswith((_JPEG, _PNG)):
        return None
    by_head = next((told for pattern, told in _HEADS.items() if pattern.match(head)), None)
    return by_head or _UNREAD.get(path.suffix.lower())


def is_web_format(path: Path) -> bool:
    """Whether a file is WebP or AVIF by its first bytes: fewer programs read these than JPEG and PNG."""
    with path.open("rb") as file:
        return _WEB.match(file.read(16)) is not None


def is_raw(path: Path, head: bytes) -> bool:
    """Whether a file is a camera's raw data, of which TIFF decoders would read the thumbnail.

    Args:
        path: the file.
        head: its first bytes.
    """
    return (unread_format(path, head) or ("",))[0] == "camera raw"


def reject_unread(where: Path, expected: str, paths: Iterable[Path], *, others: int = 0) -> None:
    """Report pictures in formats that are not read: with a DataWarning if others can be read.

    Args:
        where: the folder, for messages.
        expected: what was expected there, for messages.
        paths: files of any kind.
        others: number of pictures that are read.

    Raises:
        DataError: there are such files, and no others.
    """
    found = sorted(path for path in paths if is_unread(path))
    if not found:
        return
    name, advice = _UNREAD[found[0].suffix.lower()]
    some = f"{found[0].name}, ..." if len(found) > 1 else found[0].name
    counted = f"{len(found)} in a format that is not read ({name}: {some})"
    if not others:
        raise DataError(where, expected, counted, advice)
    message = f"{where}: of {others + len(found)} pictures, {counted} are left out. {advice}"
    warnings.warn(message, DataWarning, stacklevel=3)


def warn_of_truncated(where: object, paths: Iterable[Path]) -> None:
    """Warn with DataWarning about JPEG and PNG files that end before the picture does, without decoding them.

    Args:
        where: the folder, for messages.
        paths: the files; paths that are not files are skipped.
    """
    files = [path for path in paths if path.is_file()]
    if damaged := [str(path) for path in files if _ends_early(path)]:
        message = f"{where}: {len(damaged)} of {len(files)} pictures that were checked are cut off"
        warnings.warn(f"{message} ({shortened(damaged)}); fetch them again", DataWarning, stacklevel=3)


def _ends_early(path: Path) -> bool:
    """Whether a picture is cut off. A large file is read whole only if its last bytes have no end mark."""
    with path.open("rb") as file:
        head, size = file.read(len(_PNG)), path.stat().st_size
        end = next((mark for start, mark in _ENDS.items() if head.startswith(start)), None)
        if end is None:
            return False
        file.seek(max(0, size - _TAIL))
        if size > _LARGE and end in file.read():
            return False
        file.seek(0)
        return is_truncated(file.read())


def is_truncated(content: bytes) -> bool:
    """Whether the bytes of a JPEG or PNG picture end before the picture does; other formats give False.

    Whatever follows the end does not matter: the video of a motion photo, further pictures of MPO, padding.
    The end marks of thumbnails lie within segments, which are skipped.
    """
    if content.startswith(_JPEG[:2]):
        return not _jpeg_ends(content)
    if content.startswith(_PNG[:4]):
        return not _png_ends(content)
    return False


def _jpeg_ends(content: bytes) -> bool:
    found = _MARKER.search(content, 2)
    while found is not None:
        marker, after = content[found.end() - 1], found.end()
        if marker == _END_OF_IMAGE:
            return True
        if not (marker == 0x01 or 0xD0 <= marker <= 0xD8):  # those have no length
            after += int.from_bytes(content[after : after + 2], "big")
        found = (_AFTER_SCAN if marker == _START_OF_SCAN else _MARKER).search(content, after)
    return False


def _png_ends(content: bytes) -> bool:
    at = len(_PNG)
    while at + 8 <= len(content):
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        if kind == b"IEND":
            return True
        if not kind.isalpha():
            return False
        at += 12 + length
    return False
