"""`--logger`: what a log holds, that a stop leaves no trace in it, and that it changes nothing."""

import csv
import importlib.metadata
import json
import math
import struct

import pytest

from mjcollect.learning.logs import TrainingLog
from train import generalist, mission, segment
from train.support import training_loop
from train.support.run_folder import RunFolder

TINY = (  # noqa: SIM905 - reads like the command line
    "--updates 80 --extra-updates 0 --envs 8 --batch 16 --buffer 1000 --width 8 --demonstrations "
    "64 --eval-every 16 --eval-episodes 2 --threads 1 --checkpoint-every 40 --no-video --no-plots"
).split()
TIMED = {"training/seconds", "training/updates_per_second"}
LOGGERS = ["csv", "tensorboard"]


def run(scene_file, out, *more):
    return segment.main(["--scene", str(scene_file), "--out", str(out), *TINY, *more])


def scalars(logger, folder):
    """What a log holds: steps and values by name."""
    if logger == "csv":
        base = folder / "logs/csv/scalars"
        return {
            str(file.relative_to(base).with_suffix("")): [
                (int(step), float(value)) for step, value in csv.reader(file.open())
            ]
            for file in base.rglob("*.csv")
        }
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    read = accumulator.EventAccumulator(
        str(folder / "logs/tensorboard"), {"scalars": 0}, purge_orphaned_data=False
    )
    read.Reload()
    return {
        name: [(event.step, event.value) for event in read.Scalars(name)]
        for name in read.Tags()["scalars"]
    }


def columns(folder):
    """What metrics.csv holds: steps and values by column, without empty cells."""
    found = {}
    for row in csv.DictReader((folder / "metrics.csv").open()):
        for column, value in row.items():
            if value:
                found.setdefault(column, []).append((int(row["update"]), float(value)))
    return found


@pytest.fixture(scope="module")
def plain(scene_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "plain"
    run(scene_file, out)
    assert not (out / "logs").exists()
    return out


@pytest.fixture(scope="module", params=LOGGERS)
def logged(request, scene_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / request.param
    run(scene_file, out, "--logger", request.param)
    return request.param, out


def test_a_log_holds_what_metrics_csv_holds(logged):
    logger, out = logged
    log, wanted = scalars(logger, out), columns(out)
    assert {"eval_success_rate", "critic_loss", "episode_return"} <= set(wanted)
    assert {name.split("/")[1] for name in set(log) - TIMED} == set(wanted)
    for name in set(log) - TIMED:
        group, column = name.split("/")
        assert (group == "evaluation") == column.startswith(("eval_", "best_"))
        assert [step for step, _ in log[name]] == [step for step, _ in wanted[column]]
        expected = [value for _, value in wanted[column]]  # TensorBoard keeps 32 bits
        assert [value for _, value in log[name]] == pytest.approx(expected, rel=1e-6)
    steps = [step for step, _ in wanted["update"]]
    assert [step for step, _ in log["training/seconds"]] == steps
    times = [value for _, value in log["training/seconds"]]
    assert times == sorted(times)


def test_the_settings_are_its_hyperparameters(logged):
    logger, out = logged
    config = json.loads((out / "config.json").read_text())
    if logger == "csv":
        lines = (out / "logs/csv/texts/hparams0.txt").read_text().splitlines()
        found = dict(line.split(": ", 1) for line in lines)
        wanted = {f"learn.{key}": str(value) for key, value in config["learn"].items()}
        assert wanted.items() <= found.items()
        assert (found["seed"], found["order"]) == ("0", str(config["order"]))
        return
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    (file,) = (out / "logs/tensorboard").iterdir()  # one run, not another for the settings
    values = [v for event in EventFileLoader(str(file)).Load() for v in event.summary.value]
    data = [
        HParamsPluginData.FromString(value.metadata.plugin_data.content)
        for value in values
        if value.metadata.plugin_data.plugin_name == "hparams"
    ]
    (begun,) = [d.session_start_info.hparams for d in data if d.HasField("session_start_info")]
    assert begun["learn.gamma"].number_value == config["learn"]["gamma"]
    assert begun["learn.reward"].string_value == config["learn"]["reward"]
    assert begun["scene"].string_value == "hop"


def test_a_log_changes_no_bit_of_the_training(plain, logged):
    _, out = logged
    for name in ("policy.pt", "metrics.csv", "trajectory.csv", "config.json"):
        assert (out / name).read_bytes() == (plain / name).read_bytes(), name


def test_stopped_killed_and_resumed_it_is_the_log_of_one_go(
    logged, scene_file, tmp_path, monkeypatch
):
    """Ctrl-C after 24 updates, and an end at 56 that loses what came after the checkpoint."""
    logger, whole = logged
    made, ends = [0], {"stop": 24, "kill": 56}
    learn = training_loop.Trainer.run

    class Pressed:
        def __enter__(self):
            return lambda: made[0] == ends["stop"]

        def __exit__(self, *_):
            return False

    def counted(trainer):
        for made[0] in learn(trainer):
            yield made[0]
            if made[0] == ends["kill"]:
                raise KeyboardInterrupt

    monkeypatch.setattr(training_loop.Trainer, "run", counted)
    monkeypatch.setattr(training_loop, "stop_on_ctrl_c", Pressed)
    assert run(scene_file, tmp_path / "out", "--logger", logger) == 130
    assert run(scene_file, tmp_path / "out", "--logger", logger, "--resume") == 130
    killed = scalars(logger, tmp_path / "out")["training/update"]
    assert [step for step, _ in killed][-1] == 48  # the checkpoint is of 24
    ends["kill"] = -1
    run(scene_file, tmp_path / "out", "--logger", logger, "--resume")
    log, wanted = scalars(logger, tmp_path / "out"), scalars(logger, whole)
    assert set(log) == set(wanted)
    for name in log:
        compared = slice(0, 1) if name in TIMED else slice(None)
        assert [entry[compared] for entry in log[name]] == [e[compared] for e in wanted[name]], name
    seconds = [value for _, value in log["training/seconds"]]
    assert seconds == sorted(seconds)
    assert dict(killed).items() <= dict(log["training/update"]).items()


def test_overwrite_removes_the_log_of_the_run_before(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.create({}, None, overwrite=False)
    TrainingLog("csv", folder.path / "logs", {"seed": 0})
    assert (folder.path / "logs").is_dir()
    folder.unlock()
    folder.create({}, None, overwrite=True)
    folder.unlock()
    assert not (folder.path / "logs").exists()


def test_speed_is_that_since_the_row_before_and_nan_is_left_out(tmp_path):
    rows = [
        {"update": 0, "eval_time": math.nan},
        {"update": 10, "eval_time": 2.0},
        {"update": 40, "eval_time": math.inf},
    ]
    with TrainingLog("csv", tmp_path / "logs", {}) as log:
        log.write(rows[:1], [0.0])
        log.write(rows, [0.0, 4.0, 9.0])
        log.write(rows, [0.0, 4.0, 9.0])
    found = scalars("csv", tmp_path)
    assert found["training/updates_per_second"] == [(10, 2.5), (40, 6.0)]
    assert found["evaluation/eval_time"] == [(10, 2.0)]
    assert found["training/update"] == [(0, 0.0), (10, 10.0), (40, 40.0)]


@pytest.mark.parametrize("program", [segment, mission, generalist])
@pytest.mark.parametrize(("logger", "extra"), [("tensorboard", "viz"), ("wandb", "wandb")])
def test_a_logger_that_is_not_installed_is_refused_before_any_work(
    program, logger, extra, tmp_path, monkeypatch, capsys
):
    version = importlib.metadata.version

    def missing(name):
        if name == logger:
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    assert program.main(["--out", str(tmp_path / "out"), "--logger", logger]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --logger: {logger}: is not installed")
    assert f"pip install 'mjcollect[{extra}]'" in error
    assert not (tmp_path / "out").exists()


def test_every_segment_of_a_mission_has_its_log(scene_file, tmp_path):
    check_mission(scene_file, tmp_path / "out", "tensorboard")


@pytest.mark.slow
def test_so_has_every_segment_trained_by_ray(scene_file, tmp_path):
    pytest.importorskip("ray", reason="Ray is an optional extra")
    check_mission(scene_file, tmp_path / "out", "csv", "--ray", "local")


def check_mission(scene_file, out, logger, *more):
    arguments = ["--scene", str(scene_file), "--out", str(out), *TINY, "--updates", "32"]
    arguments += ["--policy", "none", "--retries", "0", "--logger", logger]
    assert mission.main([*arguments, *more]) in (0, 1)
    for index in range(3):
        folder = out / "segments" / str(index)
        log = scalars(logger, folder)
        assert log["training/update"] == columns(folder)["update"]
        losses = [value for _, value in columns(folder)["critic_loss"]]
        assert [value for _, value in log["training/critic_loss"]] == pytest.approx(losses)


def test_weights_and_biases_offline(plain, scene_file, tmp_path, monkeypatch):
    """Neither an account nor a network is asked for; only one offline run is there in the end."""
    pytest.importorskip("wandb", reason="wandb is an optional extra")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # nobody answers there
    out = tmp_path / "out"
    run(scene_file, out, "--logger", "wandb")
    assert (out / "policy.pt").read_bytes() == (plain / "policy.pt").read_bytes()
    (file,) = out.glob("logs/wandb/offline-run-*/run-*.wandb")
    history, config = wandb_records(file)
    rows = list(csv.DictReader((out / "metrics.csv").open()))
    assert [line["training/update"] for line in history] == [int(row["update"]) for row in rows]
    for line, row in zip(history, rows, strict=True):
        for column, value in row.items():
            group = "evaluation" if column.startswith(("eval_", "best_")) else "training"
            assert line.get(f"{group}/{column}") == (float(value) if value else None)
    assert config["learn.gamma"] == json.loads((out / "config.json").read_text())["learn"]["gamma"]


def wandb_records(file):
    """History and configuration in a .wandb file: a LevelDB log, after a header of 7 bytes."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, whole, history, config = file.read_bytes(), 7, b"", [], {}
    while at + 7 <= len(data):
        if (left := 32768 - at % 32768) < 7:
            at += left
            continue
        _, size, kind = struct.unpack("<IHB", data[at : at + 7])
        whole += data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or its last part
            record, whole = Record.FromString(whole), b""
            items = {
                item.key or "/".join(item.nested_key): json.loads(item.value_json)
                for item in record.history.item
            }
            if items:
                history.append(items)
            config |= {item.key: json.loads(item.value_json) for item in record.config.update}
            config |= {item.key: json.loads(item.value_json) for item in record.run.config.update}
    return history, config
