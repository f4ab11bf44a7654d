"""Files in and out; the formats are described in ``docs/formats.md``."""
