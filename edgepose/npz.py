"""What a damaged .npz file makes numpy and zipfile raise."""

from __future__ import annotations

import tokenize
import zipfile
import zlib

BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,  # passwords; NotImplementedError for odd compression is one, too
    MemoryError,
    # An array's header is Python text, which numpy parses.
    SyntaxError,
    tokenize.TokenError,
)
"""To be caught around reading one; OSError, of a file that is not there, apart."""
