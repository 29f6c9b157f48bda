"""The command that lints camera files: sentences and exit status."""

import numpy as np
import pytest

from cosp.camera.tsai import tsai_text
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters
from cosp.lint import main
from tests.camera.test_lint import AFT, MENDED


@pytest.fixture
def camera_path(tmp_path):
    path = tmp_path / "aft.tsai"
    path.write_text(tsai_text(MENDED), encoding="utf-8")
    return path


def test_a_faultless_camera_exits_with_zero(camera_path, capsys):
    assert main([str(camera_path)]) == 0
    assert capsys.readouterr().out == f"{camera_path}: no fault found.\n"


def test_every_fault_is_one_line_and_the_status_is_one(camera_path, tmp_path, capsys):
    (tmp_path / "wrong.tsai").write_text(tsai_text(AFT), encoding="utf-8")
    assert main([str(camera_path), str(tmp_path / "wrong.tsai")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert all(line.endswith(".") for line in lines)


@pytest.mark.parametrize(("text", "said"), [("PINHOLE\n", "line 1"), (None, "No such file")])
def test_a_file_that_is_no_camera_is_said(tmp_path, text, said, capsys):
    path = tmp_path / "camera.tsai"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    assert main([str(path)]) == 1
    assert said in capsys.readouterr().out


def test_an_image_of_another_size_is_said(camera_path, tmp_path, capsys):
    rasters.write(tmp_path / "image.tif", np.ones((40, 60), np.uint8), grid=PixelGrid(0.5, 0.5, 1, 1, (40, 60)))
    assert main([str(camera_path), "--image", str(tmp_path / "image.tif")]) == 1
    assert "image_size is 110507 7904; the image has 60 columns and 40 rows." in capsys.readouterr().out
