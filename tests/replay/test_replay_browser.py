"""Replays in a real browser: they render, play, answer, and ask nobody for anything."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.common.by import By

from benchmarks.browser import CHROMIUM, DRIVER, chromium, console, requests
from mjcollect.replay import write_replay
from mjcollect.scene.trajectory import Trajectory

if CHROMIUM is None or DRIVER is None:
    pytest.skip(
        "NOT TESTED: replays in a browser; apt-get install chromium chromium-driver",
        allow_module_level=True,
    )

SIZE = (900, 600)
BLUE, RED = (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)  # of the first and the second run


class Page:
    """A replay in the browser."""

    def __init__(self, driver, path: Path) -> None:
        self.driver, self.path = driver, path
        for said in ("browser", "performance"):
            driver.get_log(said)  # of the page before
        driver.get(path.as_uri())
        self.wait("return window.replay !== undefined && replay.state().frames > 0")

    def run(self, script: str):
        return self.driver.execute_script(script)

    def state(self) -> dict:
        return self.run("return replay.state()")

    def wait(self, script: str, seconds: float = 60.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := self.run(script):
                return value
            time.sleep(0.05)
        raise AssertionError(f"never true: {script}; {console(self.driver)}")

    def picture(self) -> np.ndarray:
        """What is drawn, without plates and labels (H, W, 3)."""
        self.run(
            "document.querySelectorAll('.plate, #labels').forEach(e => e.style.visibility='hidden')"
        )
        image = Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")
        self.run("document.querySelectorAll('.plate, #labels').forEach(e => e.style.visibility='')")
        return np.asarray(image).astype(int)

    def seek(self, t: float) -> None:
        before = self.run(f"replay.act.seek({t}); return replay.state().frames")
        self.wait(f"return replay.state().frames > {before}")

    def press(self, key: str, shift: bool = False) -> dict:
        before, chain = self.state()["frames"], ActionChains(self.driver)
        if shift:
            chain.key_down(Keys.SHIFT).send_keys(key).key_up(Keys.SHIFT).perform()
        else:
            chain.send_keys(key).perform()
        self.wait(f"return replay.state().frames > {before}")
        return self.state()

    def point_at(self, x: float, y: float) -> ActionChains:
        chain = ActionChains(self.driver, duration=20)
        chain.w3c_actions.pointer_action.move_to_location(round(x), round(y))
        return chain

    def check_quiet(self) -> None:
        assert console(self.driver) == []
        assert set(requests(self.driver)) == {self.path.as_uri()}


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory):
    with chromium(tmp_path_factory.mktemp("profile"), SIZE) as running:
        yield running


@pytest.fixture
def page(driver, mission, tmp_path) -> Page:
    write_replay([mission], tmp_path / "replay.html")
    return Page(driver, tmp_path / "replay.html")


def near(picture: np.ndarray, colour: tuple[int, ...]) -> int:
    """How many pixels have nearly that colour."""
    return int((np.abs(picture - colour).max(axis=-1) < 26).sum())


def test_it_renders_and_plays_and_asks_for_nothing(page):
    still = page.picture()
    assert still.shape == (*SIZE[::-1], 3)
    assert len(np.unique(still.reshape(-1, 3), axis=0)) > 500
    for name, colour in (("item", (242, 166, 0)), ("UAV", (255, 96, 16))):
        assert near(still, colour) > 20, name
    page.driver.find_element(By.ID, "play").click()
    page.wait("return replay.state().t > 1.5")
    assert page.state()["playing"]
    page.driver.find_element(By.ID, "play").click()
    assert not page.state()["playing"]
    moved = page.picture()
    assert (np.abs(moved - still).max(axis=-1) > 30).sum() > 100
    assert page.run("return replay.uavs()[0].speed") > 1.0
    page.run("replay.act.rate(16); replay.act.toggle()")
    page.wait("return replay.state().t === replay.state().duration && !replay.state().playing")
    assert page.driver.find_element(By.CSS_SELECTOR, ".goal").text == "2 of 2 items · arrived"
    page.check_quiet()


def test_the_uav_is_where_the_flight_was(page, mission):
    truth = Trajectory.load(mission / "trajectory.csv")
    for t in (0.0, 1.234, 5.61, 9.0, truth.t[-1]):
        page.seek(t)
        (uav,) = page.run("return replay.uavs()")
        at = [np.interp(t, truth.t, truth.x[:, axis]) for axis in range(3)]
        np.testing.assert_allclose(uav["x"], at, atol=0.02)
        speed = np.interp(t, truth.t, np.linalg.norm(truth.v, axis=1))
        assert uav["speed"] == pytest.approx(speed, abs=0.3)
    page.check_quiet()


def test_keys(page, mission):
    truth = Trajectory.load(mission / "trajectory.csv")
    assert page.press(Keys.END)["t"] == pytest.approx(truth.duration, abs=1e-4)
    assert page.press(Keys.HOME)["t"] == 0.0
    assert page.press(Keys.ARROW_RIGHT)["t"] == 1.0
    assert page.press(Keys.ARROW_RIGHT, shift=True)["t"] == 6.0
    stop = page.press("[")["t"]  # back to the first item
    row = np.searchsorted(truth.t, stop - 1e-9)
    assert not truth.v[row].any()
    assert 0.0 < stop < 6.0
    rate = page.state()["rate"]
    assert page.press(Keys.ARROW_UP)["rate"] == 2 * rate
    pictures = []
    for key, camera in (("1", "orbit"), ("2", "chase"), ("3", "top")):
        assert page.press(key)["camera"] == camera
        pictures.append(page.picture())
    assert (np.abs(pictures[0] - pictures[1]).max(axis=-1) > 30).mean() > 0.05
    assert (np.abs(pictures[1] - pictures[2]).max(axis=-1) > 30).mean() > 0.05
    assert page.press("x")["glass"]
    assert page.press("t")["theme"] == "dark"
    assert page.picture().mean() < pictures[2].mean() - 60
    assert page.press(" ")["playing"]
    assert not page.press(" ")["playing"]
    page.check_quiet()


def test_scrubbing(page):
    scrub = page.driver.find_element(By.ID, "scrub")
    duration = page.state()["duration"]
    ActionChains(page.driver).move_to_element(scrub).click().perform()
    assert page.state()["t"] == pytest.approx(duration / 2, rel=0.03)
    quarter = scrub.rect["width"] / 4
    drag = ActionChains(page.driver).click_and_hold(scrub).move_by_offset(quarter, 0).release()
    drag.perform()
    assert page.state()["t"] == pytest.approx(0.75 * duration, rel=0.03)
    page.check_quiet()


def test_what_is_under_the_cursor_is_named(page):
    tip = page.driver.find_element(By.ID, "tip")
    before = page.picture()
    for number, said in (
        (1, "no-fly zone 1\n40.0 × 60.0 × 50.0 m, turned by 30°"),
        (0, "box 0\n40.0 × 60.0 × 90.0 m"),
    ):
        page.point_at(*page.run(f"return replay.box({number})")).perform()
        head = said.split("\n")[0]
        page.wait(f"return document.getElementById('tip').textContent.startsWith('{head}')")
        assert tip.text == said
    marked = page.picture()
    assert (np.abs(marked - before).max(axis=-1) > 30).sum() > 100  # it is lit up
    page.point_at(3, SIZE[1] / 2).perform()
    page.wait("return document.getElementById('tip').hidden")
    page.check_quiet()


def test_two_runs_fly_side_by_side(driver, mission, other, tmp_path):
    write_replay([mission, other], tmp_path / "two.html")
    page = Page(driver, tmp_path / "two.html")
    page.seek(3.0)
    one, two = page.run("return replay.uavs()")
    assert (one["label"], two["label"]) == ("first", "second")
    assert np.linalg.norm(np.subtract(one["screen"], two["screen"])) > 20
    picture = page.picture()
    assert near(picture, BLUE) > 20
    assert near(picture, RED) > 20
    rows = [row.text for row in driver.find_elements(By.CSS_SELECTOR, ".row")]
    truth = Trajectory.load(mission / "trajectory.csv")
    assert f"{truth.duration:.1f} s" in rows[0]
    assert "CONTACT at 2.50 s" in rows[1]
    page.check_quiet()


def test_a_fleet(driver, fleet, tmp_path):
    write_replay([fleet], tmp_path / "fleet.html")
    page = Page(driver, tmp_path / "fleet.html")
    assert [uav["label"] for uav in page.run("return replay.uavs()")] == ["UAV 0", "UAV 1", "UAV 2"]
    assert page.press("n")["followed"] == 1
    page.press("2")
    page.seek(5.0)
    assert len(np.unique(page.picture().reshape(-1, 3), axis=0)) > 200
    page.check_quiet()
