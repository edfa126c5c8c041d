"""Files of results: archives of arrays, metadata and what it must be, manifests, checksums, the folder for what is kept."""
