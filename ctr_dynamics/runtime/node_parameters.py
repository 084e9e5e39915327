"""Parameters of the nodes beside the estimator: they drive declaration, checks and the reference."""

from __future__ import annotations

from ctr_dynamics.parameters import RELIABILITY, Parameter

DRIVER = (
    Parameter("bag", "str", "", "", "Bag to play: an .mcap file or a folder with one."),
    Parameter("start_s", "float", 0.0, "s", "Left out at the beginning of the bag.", 0.0, 1e6),
    Parameter("duration_s", "float", 0.0, "s", "Played from there on; 0: to the end.", 0.0, 1e6),
    Parameter("reliability", "str", "best_effort", "", "Reliability offered.", choices=RELIABILITY),
    Parameter("depth", "int", 50, "", "Messages kept, each topic.", 1, 10000),
    Parameter("wait_s", "float", 120.0, "s", "Longest wait for a subscriber of the joint states.", 0.0, 1e6),
    Parameter(
        "clock_hz",
        "float",
        0.0,
        "Hz",
        "Above 0: publish /clock at this rate with the bag's own time, stamps unchanged.",
        0.0,
        10000.0,
    ),
    Parameter("report", "str", "", "", "JSON file for what was played, written at the end; empty: none."),
)
VIEW = (
    Parameter("robot", "str", "till2020_tissue", "", "Shipped robot or path of a robot file."),
    Parameter("rate_hz", "float", 30.0, "Hz", "Pictures in a second, at most.", 0.01, 1000.0),
    Parameter("diameter_scale", "float", 1.0, "", "Magnification of the tubes' diameters.", 0.01, 1000.0),
    Parameter(
        "ellipsoid_scale", "float", 10.0, "", "Magnification of the tip's 95 % ellipsoid.", 0.01, 1000.0
    ),
)
NODES = {"/ctr/driver": DRIVER, "/ctr/view": VIEW}
