"""What slow motion says of a robot and its sensors: alignment of tracker and joints, and calibration of a robot file by the static model."""
