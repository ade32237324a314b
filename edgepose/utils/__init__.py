"""Files, sockets and parsers for use by any module; nothing here depends on poses."""
