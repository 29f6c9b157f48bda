"""Predict the camera of a scene: film size, archive corners and mission in, first camera out."""

from cosp.camera import prediction
from cosp.camera.missions import mission_for
from cosp.io import records
from cosp.io.logs import log_to
from cosp.sheets import parse_scene_id


def predict_camera(film_summary_path, camera_path, *, scene, camera, look, corners_deg):
    film = records.read_json(film_summary_path)
    corners = prediction.Corners(
        **{name: (corners_deg[f"{name}_lon"], corners_deg[f"{name}_lat"]) for name in ("nw", "ne", "se", "sw")}
    )
    predicted = prediction.predict_camera(
        scene,
        corners,
        mission=mission_for(camera),
        look=look,
        descending=parse_scene_id(scene).descending,
        half_length_mm=film["half_length_mm"],
        half_width_mm=film["half_width_mm"],
    )
    records.write(camera_path, predicted)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        predict_camera(
            film_summary_path=snakemake.input.film_summary,
            camera_path=snakemake.output.camera,
            scene=snakemake.params.scene,
            camera=snakemake.params.camera,
            look=snakemake.params.look,
            corners_deg=snakemake.params.corners,
        )
