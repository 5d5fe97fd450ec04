"""The recorded drive: an open format that any simulator can write."""
