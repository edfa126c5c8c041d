"""The manifest of a folder of results: what is in the folder, with a checksum, and what binds files to their run or sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nsmodel.archive import digest_of_document
from nsmodel.errors import StorageError
from nsmodel.fields import refuse_other_types
from nsmodel.storage import FORMAT, Metadata, format_of, inside, read_json

MANIFEST = "manifest.json"


def bound_to(*settings: Any) -> str:
    """The digest of a run or of a sweep: of this format and of all that its numbers depend on, as JSON holds it."""
    return digest_of_document({"format": FORMAT, "settings": list(settings)})


def signed(manifest: Metadata) -> dict[str, Any]:
    """A manifest with its checksum."""
    return {**manifest, "checksum": digest_of_document(manifest)}


def is_signed(manifest: Any) -> bool:
    """Whether a manifest has the checksum that it should, which is taken away; that of older formats is shorter."""
    there = manifest.pop("checksum", None)
    return isinstance(there, str) and len(there) >= _SHORT and digest_of_document(manifest).startswith(there)


_SHORT = 16


def read_manifest(folder: Path, fields: Any, *, what: str, afresh: str) -> dict[str, Any]:
    """The manifest of a run or sweep that is to go on.

    Args:
        folder: where it is.
        fields: its names and types.
        what: "run" or "sweep"; afresh: how to do without it, for messages.

    Raises:
        StorageError: it was changed, is another's, or of another format than this version writes.
    """
    path = inside(folder, MANIFEST, "nsmodel")
    manifest = read_json(path)
    if not isinstance(manifest, dict):
        raise StorageError(f"{path} is not a manifest; {afresh}")
    if format_of(manifest, path) < FORMAT:
        about = manifest.get("metadata") or manifest.get("settings")
        versions = about.get("versions") if isinstance(about, dict) else None
        by = versions.get("nsmodel") if isinstance(versions, dict) else None
        named = f"nsmodel {by}" if isinstance(by, str) else "an older nsmodel"
        raise StorageError(
            f"{path} is of format {format_of(manifest, path)}, written by {named}: its files can be read, but this version does "
            f"not continue the {what}; go on with {named}, or {afresh}"
        )
    if not is_signed(manifest):
        raise StorageError(f"{path} was changed after it was written; {afresh}")
    refuse_other_types(manifest, fields, path)
    return manifest
