import json
import re
import shutil
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support import lose, paper

import hpgr
from studies import explore
from studies.show import page, report
from studies.sweep import netcdf, sweep

BASE = {"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60}
NASTY = "odd: </script><img src=x onerror=alert(1)> & 'quoted' \u2028 <!-- <script>"
SIX_DIGITS = 5.1e-6  # half a unit of the sixth digit, relative to a number that begins with 1; and a little rounding


def refined(axes, replicates=2, base=None):
    return sweep(paper(BASE | (base or {})), axes, replicates=replicates)


@pytest.fixture(scope="module")
def three():
    """Three axes, the first unsorted and with a value that is refused; diagnostics that are no safe HTML."""
    speeds = {"rolls.speed": ["10 rpm", "20 rpm"]}
    result = refined({"rolls.gap": ["60 mm", "40 mm", "1.2 m"], "feed.top_size": [0.03, 0.06]} | speeds)
    lose(result, "boom <b>", gap=1, feed_top_size=0, roll_speed=0, replicate=1)
    texts = result["diagnostics"].values.astype(object)
    texts[0, 0, 0, 0] = f"{texts[0, 0, 0, 0]}\n{NASTY}".strip()
    result["diagnostics"] = (result["diagnostics"].dims, texts)
    return result


SWEEPS = {
    "one": ({"rolls.gap": ["40 mm", "50 mm"]}, 2, {}),
    "text": ({"elasticity.integrator": ["euler", "increment"], "strength.cushioning": [0.5, np.inf]}, 1, {}),
    "stress": ({"rolls.gap": ["40 mm", "50 mm"]}, 2, {"resolution.cells": 0}),
    "ragged": ({"resolution.streamlines": [2, 3]}, 2, {}),
    "none": ({}, 1, {"resolution.cells": 0}),
    "map": ({"rolls.gap": [0.06, 0.04, 0.05], "rolls.speed": [1.0, 2.0, 3.0]}, 1, {"resolution.cells": 0}),
}


@cache
def kept(name):
    return refined(*SWEEPS[name])


def swept(name):
    """Return a sweep of a kind, free to be changed."""
    return kept(name).copy(deep=True)


@pytest.fixture(scope="module", params=["three", *SWEEPS])
def saved(request, three, tmp_path_factory):
    """Return a sweep as a file holds it, and that file."""
    made = three if request.param == "three" else swept(request.param)
    path = tmp_path_factory.mktemp("saved") / f"{request.param}.nc"
    netcdf.write_dataset(made, path)
    return explore.opened(path), path


def embedded(page):
    """Return the data of a page, found as a browser finds it: up to the first end of the element."""
    text = re.search(r'<script type="application/json" id="data">(.*?)</script', page, re.DOTALL | re.IGNORECASE)[1]
    return json.loads(text)


def array(values, *shape):
    return np.array([np.nan if value is None else value for value in values], float).reshape(shape)


def flat(result, name):
    """Return a variable as (operating point, replicate, ...), NaN where the case is lost."""
    axes = report.axes_of(result)
    count = int(np.prod([result.sizes[axis] for axis in axes]))
    own = [dim for dim in result[name].dims if dim not in (*axes, "replicate")]
    values = result[name].transpose(*axes, "replicate", *own).values.astype(float)
    values = values.reshape(count, result.sizes["replicate"], *values.shape[len(axes) + 1 :])
    lost = result["status"].transpose(*axes, "replicate").values.reshape(values.shape[:2]) != 0
    values[lost] = np.nan
    return values


def mean_and_spread(values):
    """Over replicates, written out in plain NumPy."""
    count = np.isfinite(values).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(values, axis=1) / count
        spread = np.sqrt(np.nansum((values - mean[:, None]) ** 2, axis=1) / (count - 1))
    return np.where(count > 0, mean, np.nan), np.where(count > 1, spread, np.nan)


def agree(found, values, factor=1.0):
    """Assert that embedded means and spreads are those of (operating point, replicate, ...)."""
    mean, spread = mean_and_spread(values * factor)
    np.testing.assert_allclose(array(found["mean"], *mean.shape), mean, rtol=SIX_DIGITS)
    np.testing.assert_allclose(array(found["sd"], *mean.shape), spread, rtol=6e-4, atol=1e-6 * np.nanmax(np.abs(mean)))


def test_page_holds_the_numbers_of_the_file(saved, capsys):
    result, path = saved
    assert explore.main([str(path)]) == 0
    assert capsys.readouterr().out == f"wrote {path.with_suffix('.html')}\n"
    data = embedded(path.with_suffix(".html").read_text(encoding="utf-8"))
    assert data["name"] == path.name
    axes = report.axes_of(result)
    assert [axis["name"] for axis in data["axes"]] == axes
    assert data["replicates"] == result.sizes["replicate"]
    kpis = {one["heading"]: one for one in data["kpis"]}
    agree(kpis["throughput [t/h]"], flat(result, "throughput"), 3.6)
    agree(kpis["peak pressure [MPa]"], flat(result, "peak_pressure"), 1e-6)
    agree(kpis["peak pressure height [mm]"], flat(result, "peak_pressure_height"), 1e3)
    if "p80_total" in result:
        agree(kpis["P80 [mm]"], flat(result, "p80_total"), 1e3)
        agree(kpis["P50 [mm]"], flat(result, "p50_total"), 1e3)
        places = [int(np.argmin(np.abs(result["sieve"].values * 1e3 - size))) for size in data["sieves"]]
        assert data["sieves"] == pytest.approx(result["sieve"].values[places] * 1e3, rel=SIX_DIGITS)
        for name in {"passing_total", "passing"} & set(result):
            agree(data["passing"][name], flat(result, name)[..., places])
    else:
        assert (data["passing"], data["sieves"]) == ({}, [])
    profiles = {one["name"]: one for one in data["profiles"]}
    across = {name for name, value in result.data_vars.items() if value.dims[-1:] == ("streamline",)}
    assert set(profiles) == across
    for name in across:
        factor = {"m": 1e3, "Pa": 1e-6, "1": 1}[result[name].attrs["units"]]
        agree(profiles[name], flat(result, name), factor)
    assert data["streamlines"] == pytest.approx(result["xi"].values if "xi" in result else [], rel=SIX_DIGITS)


def test_every_scalar_of_a_sweep_is_a_figure():
    """Summaries that are still to come need no line of the explorer: unit and name say all."""
    result = swept("one")
    result["motor_power"] = result["throughput"] * 2.0
    result["motor_power"].attrs = {"units": "W", "long_name": "power of both motors"}
    passes = np.array([[1, 2], [4, 4]], np.int32)
    result["passes"] = (result["status"].dims, passes, {"units": "1", "long_name": "passes"})
    lose(result, "boom", gap=0, replicate=0)
    kpis = {one["heading"]: one for one in page.page_data(result, 1e-3, "x")["kpis"]}
    agree(kpis["motor power [kW]"], flat(result, "motor_power") / 1e3)
    assert kpis["motor power [kW]"]["about"] == "power of both motors"
    agree(kpis["W [kWh/t]"], flat(result, "specific_energy") / 3600)
    agree(kpis["Fsp [N/mm²]"], flat(result, "specific_pressing_force") / 1e6)
    assert kpis["passes"]["mean"] == [2, 4]  # of the replicate that is left: an integer has no NaN of its own
    assert kpis["passes"]["sd"] == [None, 0]
    assert not {"status", "flags"} & {one["heading"] for one in kpis.values()}


def test_axes_are_sorted_for_the_slider_and_rebuild_every_scene(three):
    data = page.page_data(three, 1e-3, "three")
    gap, top, speed = data["axes"]
    assert gap["texts"] == ["60 mm", "40 mm", "1200 mm"]
    assert gap["order"] == [1, 0, 2]
    assert gap["values"] == [60, 40, 1200]
    assert [gap["label"], top["label"], speed["label"]] == ["gap [mm]", "feed top size [mm]", "roll speed [rpm]"]
    assert speed["values"] == [10, 20]
    base = hpgr.Scene.model_validate_json(three.attrs["scene"])
    for index in np.ndindex(2, 2, 2):
        scene = json.loads(json.dumps(data["scene"]))
        for axis, k in zip(data["axes"], index, strict=True):
            for name, value in axis["changes"][k].items():
                section, key = name.split(".")
                scene[section][key] = value
        values = [item for axis, k in zip(data["axes"], index, strict=True) for item in axis["raw"][k].items()]
        assert hpgr.Scene.model_validate(scene) == base.with_values(dict(values))
    assert data["start"] == [0, 1, 1]  # 60 mm, 60 mm and 20 rpm are nearest to the paper's machine


def test_a_kind_of_law_changes_and_drops_its_fields():
    """As the page puts a scene together: None takes a field out."""
    base = paper(BASE | {"flow.exponent": 2.0})
    found = page.changes(base, {"flow.kind": "nip", "flow.nip_angle": 0.1})
    assert found["flow.exponent"] is None
    scene = json.loads(base.model_dump_json())
    scene["flow"] |= {name.partition(".")[2]: value for name, value in found.items()}
    scene["flow"] = {key: value for key, value in scene["flow"].items() if value is not None}
    assert hpgr.Scene.model_validate(scene) == base.with_values({"flow": {"kind": "nip", "nip_angle": 0.1}})


def test_infinite_and_text_axes_are_categories():
    integrator, cushioning = page.page_data(swept("text"), 1e-3, "x")["axes"]
    assert (integrator["values"], integrator["texts"]) == (None, ["euler", "increment"])
    assert (cushioning["values"], cushioning["texts"]) == (None, ["0.5", "inf"])
    assert [place["strength.cushioning"] for place in cushioning["raw"]] == [0.5, "inf"]


def test_every_operating_point_tells_its_limits_and_losses(three):
    data = page.page_data(three, 1e-3, "three")
    assert np.array(data["held"]).reshape(3, 2, 2).tolist() == [[[2, 2], [2, 2]], [[1, 2], [2, 2]], [[0, 0], [0, 0]]]
    said = data["said"]
    assert said[4][0] == ["failed", 1, "boom <b>"]
    assert said[8][0][:2] == ["refused", 2]
    assert said[8][0][2].startswith("rolls.gap: got 1200 mm; must be at most")
    assert ["odd", 1, NASTY.partition(": ")[2].splitlines()[0]] in said[0]
    assert any("Refused: gap 1200 mm" in line for line in data["told"])
    capped = [entry for entry in said[1] if entry[0] == "solid fraction capped"]
    assert [entry[1] for entry in capped] == [2]
    assert capped[0][2].startswith("mass continuity would need")


def test_feeds_follow_the_axis_of_the_feed(three):
    data = page.page_data(three, 1e-3, "three")
    sizes = np.array(data["sieves"]) * 1e-3
    assert data["feed_of"] == [0, 0, 1, 1] * 3
    for found, top in zip(data["feeds"], [0.03, 0.06], strict=True):
        assert found == pytest.approx(np.clip((sizes - 0.008) / (top - 0.008), 0, 1), abs=2e-6)  # uniform from 8 mm
    assert sizes[-1] >= 0.06 > sizes[-2]  # as far as the coarsest feed, and no further


def test_a_sieve_between_the_recorded_ones_is_interpolated_in_the_log():
    result = swept("one")
    data = page.page_data(result, 1.1e-3, "x")
    assert data["sieves"][data["sieve"]] == 1.1
    found = array(data["passing"]["passing_total"]["mean"], 2, -1)[:, data["sieve"]]
    logs = np.log(result["sieve"].values)
    expected = [np.interp(np.log(1.1e-3), logs, one) for one in result["passing_total"].mean("replicate").values]
    assert found == pytest.approx(expected, rel=2e-5)


def test_text_of_a_sweep_cannot_leave_its_place(three):
    data = page.page_data(three, 1e-3, "<x> & @@DATA@@")
    text = page.page_of(data, "let a = '@@TITLE@@';", 'explore "a.nc"')
    assert text == page.page_of(data, "let a = '@@TITLE@@';", 'explore "a.nc"')  # the same bytes
    assert text.count("</script") == 3  # data, library, page
    assert "onerror=alert" not in re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.DOTALL)
    assert "<title>&lt;x&gt; &amp; @@DATA@@ - hpgr explorer</title>" in text
    assert '<meta name="generator" content="explore &quot;a.nc&quot;">' in text
    data = embedded(text)
    assert data["name"] == "<x> & @@DATA@@"
    assert any(what == "odd" and "</script><img src=x" in text for what, _, text in data["said"][0])


def test_page_names_nothing_to_fetch():
    template = (Path(page.__file__).parent / "page.html").read_text(encoding="utf-8")
    assert not re.findall(r"https?:|//[a-z]+\.|url\(|@import|\bfetch\(|XMLHttpRequest|<script src|<iframe", template)
    assert "default-src 'none'" in template


def test_most_numbers_counts_what_is_embedded(three, monkeypatch):
    def count(value):
        return len(value["mean"]) + len(value["sd"])

    data = page.page_data(three, 1e-3, "three")
    total = sum(map(count, [*data["kpis"], *data["profiles"], *data["passing"].values()]))
    monkeypatch.setattr(page, "MOST_NUMBERS", int(1.2 * total))
    page.page_data(three, 1e-3, "three")
    monkeypatch.setattr(page, "MOST_NUMBERS", int(0.9 * total))
    with pytest.raises(ValueError, match=r"big.nc: its means and spreads are .* a page holds at most.*isel\(gap="):
        page.page_data(three, 1e-3, "big.nc")


@pytest.fixture
def refused(capsys, tmp_path, monkeypatch):
    """Assert that the command writes nothing and says one error, and return it."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        before = sorted(tmp_path.rglob("*"))
        assert explore.main([str(one) for one in arguments]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("error: ")
        assert sorted(tmp_path.rglob("*")) == before
        return said.err

    return call


def test_files_without_a_sweep_are_refused(refused, tmp_path):
    assert "gone.nc: there is no such file; make one first" in refused("gone.nc")
    (tmp_path / "table.nc").write_text("gap,p80\n")
    assert "table.nc: cannot be read as NetCDF" in refused("table.nc")
    netcdf.write_dataset(hpgr.simulate(paper(BASE | {"resolution.record": "product"})), tmp_path / "run.nc")
    message = refused("run.nc")
    assert "run.nc: is not the result of a sweep: it lacks replicate, status, message, diagnostics" in message
    assert "python -m studies.gap_sweep" in message
    xr.Dataset({"a": 1}).to_netcdf(tmp_path / "other.nc")
    assert "the attribute scene" in refused("other.nc")
    netcdf.write_dataset(refined({"rolls.gap": ["1.2 m"]}), tmp_path / "lost.nc")
    message = refused("lost.nc")
    assert "lost.nc: no case holds a result, so there is nothing to show; the first: refused: gap 1200" in message


def test_bad_options_are_refused(refused, tmp_path, monkeypatch):
    netcdf.write_dataset(swept("one"), tmp_path / "one.nc")
    assert "--sieve: got '1'; text without a unit" in refused("one.nc", "--sieve", "1")
    assert "--sieve: got 3000 mm; must lie within" in refused("one.nc", "--sieve", "3 m")
    assert "--out: got 'one.nc'; must end with .html" in refused("one.nc", "--out", "one.nc")
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert "pip install 'plotly>=6'" in refused("one.nc")


# In a browser ---------------------------------------------------------------------------------------------------

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium that logs every request and every message."""
    if BROWSER is None or DRIVER is None:
        pytest.skip("no browser: chromium and chromedriver are not installed (Debian: chromium, chromium-driver)")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    flags = "headless=new no-sandbox disable-gpu disable-quic no-first-run disable-background-networking "
    flags += "disable-component-update disable-sync disable-dev-shm-usage window-size=1280,900"
    for flag in (*flags.split(), f"user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(f"--{flag}")
    downloads = tmp_path_factory.mktemp("downloads")
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.downloads = downloads
    yield driver
    driver.quit()


class Page:
    """The page as a user has it: what is shown, and what the keyboard and mouse do."""

    def __init__(self, driver):
        self.driver = driver

    def run(self, script):
        return self.driver.execute_script(script)

    def wait(self, script):
        from selenium.webdriver.support.ui import WebDriverWait

        return WebDriverWait(self.driver, 120, 0.05).until(lambda driver: driver.execute_script(script))

    def after(self, action):
        """Do something and wait until the page has been drawn again."""
        drawn = self.run("return document.body.dataset.drawn")
        action()
        self.wait(f"return document.body.dataset.drawn !== '{drawn}'")

    def click(self, name):
        self.after(self.driver.find_element("id", name).click)

    def press(self, name, keys):
        self.after(lambda: self.driver.find_element("id", name).send_keys(keys))

    def text(self, name):
        return self.driver.find_element("id", name).text

    def figure(self, heading):
        """Return the cells of a row of the table, selected point first."""
        [row] = [
            row
            for row in self.driver.find_elements("css selector", "#kpis tbody tr")
            if row.get_attribute("data-figure") == heading
        ]
        return [cell.text for cell in row.find_elements("tag name", "td")]

    def traces(self, chart):
        """Return the traces drawn in a chart."""
        return self.run(
            f"return document.getElementById('{chart}').data.map(t => ({{x: t.x, y: t.y, name: t.name, meta: t.meta,"
            "dash: (t.line || {}).dash, symbol: t.marker && t.marker.symbol, bars: t.error_y && t.error_y.array}))"
        )


def opened_in(browser, path):
    browser.get_log("performance"), browser.get_log("browser")  # of the page before
    browser.get(path.as_uri())
    tab = Page(browser)
    tab.wait("return document.body.dataset.drawn || !document.getElementById('trouble').hidden")
    assert tab.text("trouble") == ""
    return tab


def requests(browser):
    """Return the addresses that were asked for, but for data in the page itself and the browser's own empty tab."""
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    found = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
    return [url for url in found if not url.startswith(("data:", "blob:", "chrome:"))]


@pytest.mark.slow
def test_a_user_moves_sliders_and_pins_points(browser, three, tmp_path):
    from selenium.webdriver.common.keys import Keys

    netcdf.write_dataset(three, tmp_path / "three.nc")
    assert explore.main([str(tmp_path / "three.nc")]) == 0
    path = tmp_path / "three.html"
    tab = opened_in(browser, path)

    def expected(name, factor, *place):
        return three[name].values[place].astype(float).mean(axis=0) * factor

    def shows(*place):
        """Assert that table and charts show an operating point."""
        columns = {"P80 [mm]": ("p80_total", 1e3), "throughput [t/h]": ("throughput", 3.6)}
        for heading, (name, factor) in columns.items():
            mean, _, spread = tab.figure(heading)[0].partition(" ± ")
            values = three[name].values[place].astype(float) * factor
            assert float(mean) == pytest.approx(values.mean(), rel=6e-4)
            assert float(spread or 0) == pytest.approx(values.std(ddof=1), rel=0.06, abs=1e-6)
        across = tab.traces("across")[-1]
        assert across["x"] == pytest.approx(three["xi"].values, rel=1e-5)
        assert across["y"] == pytest.approx(expected("p80", 1e3, *place), rel=1e-5)
        pressure = expected("streamline_peak_pressure", 1e-6, *place)
        assert tab.traces("pressure")[-1]["y"] == pytest.approx(pressure, rel=1e-5)
        [sizes] = [trace for trace in tab.traces("sizes") if trace["name"].startswith("selected")]
        known = np.interp(sizes["x"], three["sieve"].values * 1e3, 100 * expected("passing_total", 1, *place))
        drawn = np.array([0.0 if value is None else value for value in sizes["y"]])
        assert drawn == pytest.approx(known, rel=1e-4)

    assert tab.text("axis-gap-shown") == "60 mm"
    shows(0, 1, 1)
    before = tab.traces("across")[-1]["y"]
    slider = browser.find_element("id", "axis-gap")
    assert (slider.get_attribute("aria-label"), slider.get_attribute("aria-valuetext")) == ("gap", "60 mm")

    tab.click("pin")  # 60 mm stays, as A
    tab.press("axis-gap", Keys.ARROW_LEFT)
    assert tab.text("axis-gap-shown") == slider.get_attribute("aria-valuetext") == "40 mm"
    shows(1, 1, 1)
    pinned, now = tab.traces("across")
    assert pinned["y"] == before
    assert now["y"] != before
    assert {"dash", "symbol"} <= {key for key in now if now[key] != pinned[key]}  # told apart without colour
    assert len(tab.figure("P80 [mm]")) == 2
    assert "A: 60 mm, 60 mm, 20 rpm" in tab.text("points")

    # against the axis: one line for both, with a bar at each gap that holds a result
    line, *_ = tab.traces("curve2")
    assert line["x"] == [40, 60]
    values = three["p80_total"].values[[1, 0], 1, 1].astype(float) * 1e3
    assert line["y"] == pytest.approx(values.mean(axis=1), rel=1e-5)
    assert line["bars"] == pytest.approx(values.std(axis=1, ddof=1), rel=1e-3)

    # another sieve
    old = tab.figure("below")[0]
    tab.press("sieve", Keys.ARROW_RIGHT)
    assert tab.text("sieve-shown") != "1 mm"
    sieve = float(tab.text("sieve-shown").split()[0])
    below = np.interp(np.log(sieve / 1e3), np.log(three["sieve"].values), expected("passing", 100, 1, 1, 1)[0])
    assert tab.traces("fineness")[-1]["y"][0] == pytest.approx(below, rel=5e-3)  # the sieve is shown to 4 digits
    assert tab.figure("below")[0] != old

    # a lost point says so, in words, and draws nothing
    tab.press("axis-gap", Keys.END)
    assert tab.text("axis-gap-shown") == "1200 mm"
    assert "No result at this operating point" in tab.text("said")
    assert "refused (2 of 2 replicates): rolls.gap: got 1200 mm" in tab.text("said")
    assert tab.figure("P80 [mm]")[0] == "–"
    assert len(tab.traces("across")) == 1  # the pin

    # diagnostics are text, whatever they hold
    for name, key in {"gap": Keys.ARROW_LEFT, "feed_top_size": Keys.HOME, "roll_speed": Keys.HOME}.items():
        tab.press(f"axis-{name}", key)
    assert tab.text("axis-gap-shown") == "60 mm"
    assert "</script><img src=x onerror=alert(1)>" in tab.text("said")
    assert browser.find_elements("tag name", "img") == []

    # the scene of the selected point
    scene = hpgr.Scene.model_validate_json(tab.run("return document.getElementById('scene').textContent"))
    own = {"rolls.gap": 0.06, "feed.top_size": 0.03, "rolls.speed": three["roll_speed"].values[0]}
    assert scene == hpgr.Scene.model_validate_json(three.attrs["scene"]).with_values(own)

    # compare along an axis, and take the pins away
    tab.click("every-roll_speed")
    assert tab.text("points").count("rpm") == 3
    tab.click("unpin")
    assert tab.text("points") == "Selected: 60 mm, 30 mm, 10 rpm"

    # the download
    browser.find_element("id", "csv").click()
    table = waited(browser.downloads / "three-points.csv")
    heading, *rows = [line.split(",") for line in table.splitlines()]
    assert heading[:5] == ["gap [mm]", "feed top size [mm]", "roll speed [rpm]", "quantity", "unit"]
    [p80] = [row for row in rows if row[3:6] == ["P80", "mm", ""]]
    assert p80[:3] == ["60", "30", "10"]
    assert float(p80[7]) == pytest.approx(float(expected("p80_total", 1e3, 0, 0, 0)), rel=1e-5)
    assert sum(row[3] == "fraction passing (whole gap)" for row in rows) == len(tab.traces("sizes")[0]["x"])

    # printed two charts in a row, and afterwards as wide as before
    width = "document.querySelector('#across .main-svg').getBoundingClientRect().width"
    before = tab.run(f"return {width}")
    tab.run("window.dispatchEvent(new Event('beforeprint'))")
    tab.wait(f"return {width} < 320")
    tab.run("window.dispatchEvent(new Event('afterprint'))")
    tab.wait(f"return Math.abs({width} - {before}) < 2")

    # on a phone
    small = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", small)
    try:
        right = (
            "[...document.querySelectorAll('.chart .main-svg, .card')].map(one => one.getBoundingClientRect().right)"
        )
        tab.wait(f"return Math.max(...{right}) <= 360")
        assert tab.run("return document.documentElement.scrollWidth") <= 360
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

    assert tab.run("return performance.getEntriesByType('resource').map(entry => entry.name)") == []
    assert requests(browser) == [path.as_uri()]
    assert browser.get_log("browser") == []


def waited(path):
    import time

    for _ in range(200):
        if path.exists() and path.stat().st_size:
            return path.read_text(encoding="utf-8")
        time.sleep(0.05)
    raise AssertionError(f"{path.name} was not downloaded")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "ragged", "none", "map"])
def test_every_kind_of_sweep_opens_without_complaint(browser, kind, tmp_path):
    result, path = swept(kind), tmp_path / f"{kind}.nc"
    netcdf.write_dataset(result, path)
    assert explore.main([str(path)]) == 0
    tab = opened_in(browser, path.with_suffix(".html"))
    charts = {element.get_attribute("id") for element in browser.find_elements("css selector", ".chart")}
    assert ("sizes" in charts) == ("passing_total" in result)
    assert ("fineness" in charts) == ("passing" in result)
    assert ("pressure" in charts) == ("streamline_peak_pressure" in result)
    assert ("curve1" in charts) == bool(report.axes_of(result))
    assert ("map" in charts) == (kind == "map")
    if kind == "map":
        energy = tab.run("return document.getElementById('map').data[0].z")
        order = result["specific_energy"].isel(replicate=0, gap=[1, 2, 0]).transpose("roll_speed", "gap")
        assert np.array(energy) == pytest.approx(order.values / 3600, rel=1e-5)
    for chart in charts:
        assert tab.traces(chart)
        assert any(value is not None for value in tab.traces(chart)[-1]["y"])
    for axis in embedded(path.with_suffix(".html").read_text(encoding="utf-8"))["axes"]:
        assert tab.text(f"axis-{axis['name']}-shown") in axis["texts"]
    assert browser.get_log("browser") == []
    assert requests(browser) == [path.with_suffix(".html").as_uri()]
