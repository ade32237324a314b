"""The terminal: messages, keys, the live page, signals."""
