"""The small valid scene file and the bundled scenes that several tests start from."""

VALID = {
    "name": "small",
    "seed": 7,
    "bounds": {"min": [0, 0, 0], "max": [100, 100.0, 50]},
    "depot": [0, 0, 0],
    "items": [[80, 80, 20], [10, 90, 40], [90, 10, 5]],
    "obstacles": [
        {"min": [30, 30, 0], "max": [60, 60, 40]},
        {"min": [5, 5, 45], "max": [20, 20, 50]},
    ],
    "v_max": 50,
    "a_max": 20.0,
    "epsilon": 5.0,
    "slot": 0.2,
    "return_tolerance": 4.0,
}
BUNDLED = ("scenario_1", "scenario_2", "sweep_8", "city_6")
