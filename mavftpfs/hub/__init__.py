"""The process that owns a port which several programs use: it passes whole frames, and reads only headers."""
