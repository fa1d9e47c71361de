"""Maps numpy arrays, asks the map in words and saves it. The arrays come from a simulated room: put yours in their place."""

import sys

from fus3dmaps_core import Config, Intrinsics, Pipeline, PosedFrame, save_map
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom


def main(directory: str, frames: int) -> None:
    """Map some frames and save the map in a directory."""
    room = FurnishedRoom(frames=frames)
    camera = Intrinsics(fx=550.0, fy=550.0, cx=319.5, cy=239.5, width=640, height=480)
    pipeline = Pipeline.from_config(Config.from_flat({"map.voxel_size_m": 0.05}))
    for index in range(frames):
        frame = room.frame(index)
        rgb, depth_m, T_world_camera = frame.rgb, frame.depth_m, frame.T_world_camera  # uint8, float32 metres, 4x4
        report = pipeline.process(PosedFrame(frame.stamp_ns, rgb, depth_m, camera, T_world_camera))
        print(f"frame {index}: dense {report.dense}, {report.proposals} proposals")
    print(pipeline)
    answer = pipeline.ask(["a pet that meows", "a place to sit"], top_k=2)
    print(answer)
    best = answer.instances[0]
    print(f"'{best.prompt}' is at {best.centroid_m.round(2)} m; {len(answer.points_m)} voxels were compared")
    save_map(directory, pipeline)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "room", int(sys.argv[2]) if len(sys.argv) > 2 else 40)
