"""A simulated vehicle: a sans-I/O FTP server with firmware profiles, behind a model of a bad link."""
