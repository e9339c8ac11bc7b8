"""Byte and datagram pipes to the vehicle, and the MAVLink framing on them."""
