"""mavftpfs mounts a drone's files, served over MAVLink FTP, as a local directory."""

__version__ = "0.2.0"
