"""CSV logs of a tracker and of actuators as a bag: columns and units, rows, frames, messages."""
