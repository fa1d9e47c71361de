"""The version of the packages; package.xml and setup.py say the same."""

__version__ = "0.1.0"
