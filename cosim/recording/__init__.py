"""Writing a run folder: rows and fates as they come, the digest, the manifest."""
