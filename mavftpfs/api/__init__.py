"""A vehicle's files for Python programs: `mavftpfs.connect`, `mavftpfs.trio` and fsspec."""
