"""A vehicle's files for Python programs: `mavftpfs.connect` and fsspec."""
