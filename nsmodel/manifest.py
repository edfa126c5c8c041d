"""The manifest of a folder of results: what is in the folder, with a checksum, and what binds files to their run or sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nsmodel.archive import document_digest
from nsmodel.errors import StorageError
from nsmodel.fields import check_field_types
from nsmodel.storage import FILE_FORMAT, Metadata, file_format, path_inside, read_json

MANIFEST_FILE = "manifest.json"


def settings_digest(*settings: Any) -> str:
    """The digest of a run or of a sweep: of this format and of all that its numbers depend on, as JSON holds it."""
    return document_digest({"format": FILE_FORMAT, "settings": list(settings)})


def with_checksum(manifest: Metadata) -> dict[str, Any]:
    """A manifest with its checksum."""
    return {**manifest, "checksum": document_digest(manifest)}


def has_valid_checksum(manifest: Any) -> bool:
    """Whether a manifest has the checksum that it should, which is taken away; that of older formats is shorter."""
    checksum = manifest.pop("checksum", None)
    return isinstance(checksum, str) and len(checksum) >= _MIN_CHECKSUM_LENGTH and document_digest(manifest).startswith(checksum)


_MIN_CHECKSUM_LENGTH = 16


def read_manifest(folder: Path, fields: Any, *, what: str, afresh: str) -> dict[str, Any]:
    """The manifest of a run or sweep that is to go on.

    Args:
        folder: where it is.
        fields: its names and types.
        what: "run" or "sweep"; afresh: how to do without it, for messages.

    Raises:
        StorageError: it was changed, is another's, or of another format than this version writes.
    """
    path = path_inside(folder, MANIFEST_FILE, "nsmodel")
    manifest = read_json(path)
    if not isinstance(manifest, dict):
        raise StorageError(f"{path} is not a manifest; {afresh}")
    if file_format(manifest, path) < FILE_FORMAT:
        about = manifest.get("metadata") or manifest.get("settings")
        versions = about.get("versions") if isinstance(about, dict) else None
        by = versions.get("nsmodel") if isinstance(versions, dict) else None
        named = f"nsmodel {by}" if isinstance(by, str) else "an older nsmodel"
        raise StorageError(
            f"{path} is of format {file_format(manifest, path)}, written by {named}: its files can be read, but this version "
            f"does not continue the {what}; go on with {named}, or {afresh}"
        )
    if not has_valid_checksum(manifest):
        raise StorageError(f"{path} was changed after it was written; {afresh}")
    check_field_types(manifest, fields, path)
    return manifest
