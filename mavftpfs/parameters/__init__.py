"""Parameters and missions: the vehicle's packed files, and what people read and write. Layer: parameters."""
