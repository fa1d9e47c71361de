"""Maps a rosbag2 directory or MCAP file without ROS running, saves the map, loads it again and asks it."""

import sys

from fus3dmaps_core import Config, Pipeline, load_map, map_recording, save_map


def main(recording: str, directory: str, *prompts: str) -> None:
    """Map a recording whose topics have the names of the parameters below, and ask for things in words."""
    config = Config.from_flat(
        {
            "input.rgb_topic": "rgb/image",
            "input.depth_topic": "depth/image",
            "input.camera_info_topic": "rgb/camera_info",
            "input.pose_topic": "pose",
        }
    )
    pipeline = Pipeline.from_config(config)
    summary = map_recording(recording, pipeline)
    print(f"{summary.keyframes_per_s:.1f} keyframes per second: {pipeline}")
    save_map(directory, pipeline)
    saved = load_map(directory)
    for prompt in prompts or ("a place to sit",):
        print(saved.ask(prompt, top_k=1, negative_prompts=["wall", "floor"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
