"""The version of the package, apart from everything that it depends on."""

__version__ = "0.1.0"
