"""MAVLink FTP without I/O: codec, listings, client engine. Time and randomness are arguments."""
