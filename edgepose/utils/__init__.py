"""Files, sockets and parsers that any part may use; nothing in here knows of poses."""
