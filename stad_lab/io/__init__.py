"""Files, locks and workers."""
