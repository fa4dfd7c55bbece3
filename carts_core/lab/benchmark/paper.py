"""The paper's numbers: Ding et al., "CaRTS", MICCAI 2022, Table 1 and the tables of its supplement.

R is its real recording, S its synthetic one. Dice in percent, MAE in degrees, each as (mean, standard deviation).
"""

SOURCE = "Ding et al., CaRTS, MICCAI 2022 (arXiv:2203.09475)"

Value = tuple[float, float]

COLUMNS = {
    ("real", "regular"): "R-Reg",
    ("real", "low_brightness"): "R-LB",
    ("real", "bleeding"): "R-Bl",
    ("real", "smoke"): "R-Sm",
    ("real", "background_change"): "R-BC",
    ("synthetic", "regular"): "S-Reg",
    ("synthetic", "simulated_smoke"): "S-SS",
}
"""Our source and domain -> the paper's column."""

DICE: dict[str, dict[str, Value]] = {
    # From the supplement's ablation of iterations on its validation set, the only source for the U-Net.
    "unet": {
        "R-Reg": (95.0, 2.7),
        "R-LB": (84.1, 3.5),
        "R-Bl": (30.6, 13.9),
        "R-Sm": (59.7, 24.7),
        "R-BC": (76.8, 2.9),
    },
    # Table 1.
    "colleoni_none": {
        "R-Reg": (94.9, 2.7),
        "R-LB": (87.0, 4.5),
        "R-Bl": (55.0, 5.7),
        "R-Sm": (59.7, 24.7),
        "R-BC": (75.1, 3.6),
        "S-Reg": (99.8, 0.1),
        "S-SS": (41.4, 4.3),
    },
    "hrnet_smoke": {
        "R-Reg": (95.2, 2.7),
        "R-LB": (86.3, 3.9),
        "R-Bl": (56.3, 16.4),
        "R-Sm": (77.2, 23.6),
        "R-BC": (92.1, 4.6),
    },
    "swin_smoke": {
        "R-Reg": (95.0, 5.5),
        "R-LB": (93.0, 5.5),
        "R-Bl": (76.5, 9.0),
        "R-Sm": (82.4, 17.0),
        "R-BC": (94.8, 5.3),
    },
    "start": {"R-Reg": (89.4, 3.9), "S-Reg": (83.4, 6.8)},
    "l1": {
        "R-Reg": (92.7, 4.0),
        "R-LB": (89.8, 3.9),
        "R-Bl": (89.4, 3.9),
        "R-Sm": (89.8, 3.9),
        "R-BC": (89.5, 3.9),
        "S-Reg": (90.5, 10.0),
        "S-SS": (83.7, 6.9),
    },
    "paper": {
        "R-Reg": (93.4, 3.0),
        "R-LB": (92.4, 3.1),
        "R-Bl": (90.8, 4.4),
        "R-Sm": (91.6, 4.7),
        "R-BC": (92.3, 4.8),
        "S-Reg": (96.6, 2.7),
        "S-SS": (96.5, 2.4),
    },
}
"""Method -> column -> Dice of the main table."""

ITERATIONS = (1, 10, 20, 30, 50, 100)

DICE_BY_ITERATIONS: dict[str, tuple[Value, ...]] = {
    "R-Reg": ((90.4, 3.8), (92.6, 3.3), (93.1, 3.3), (93.2, 3.1), (93.5, 3.1), (93.6, 2.9)),
    "R-LB": ((90.2, 3.7), (91.8, 3.4), (92.0, 3.1), (92.2, 3.0), (92.5, 3.0), (92.7, 2.8)),
    "R-BC": ((90.2, 3.7), (91.9, 3.2), (92.0, 3.1), (92.1, 3.0), (92.4, 3.0), (92.4, 3.1)),
    "R-Sm": ((90.0, 3.9), (91.4, 4.3), (91.5, 4.6), (91.5, 4.8), (91.5, 5.2), (91.4, 5.5)),
    "R-Bl": ((90.2, 3.8), (91.3, 3.9), (91.1, 4.0), (91.1, 4.3), (91.1, 4.3), (91.0, 4.5)),
}
"""Column -> Dice for each of `ITERATIONS`."""

DICE_BY_ERROR: dict[str, dict[float, Value]] = {
    "R-Reg": {0: (93.4, 3.1), 1: (92.2, 4.3), 2: (86.1, 9.1), 3: (76.2, 14.0)},
    "S-Reg": {0: (98.1, 0.7), 1: (97.9, 1.3), 2: (95.3, 4.1), 3: (90.3, 5.2)},
}
"""Column -> error at the start [deg] -> Dice."""

MAE_BY_ERROR: dict[str, dict[float, Value]] = {
    "R-Reg": {1: (0.6, 0.4), 2: (1.4, 0.6), 3: (2.6, 0.6)},
    "S-Reg": {1: (0.1, 0.1), 2: (0.4, 0.4), 3: (1.3, 0.4)},
}
"""Column -> error at the start [deg] -> joint MAE [deg]."""
