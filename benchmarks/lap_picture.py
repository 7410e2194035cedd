"""The moving picture at the head of the README, a film of a lap as an animated WebP, and the still of docs/camera.md.

deepracer-exp train experiment=fast_lap name=season
deepracer-exp evaluate best:season evaluation.held_out=null --video lap.mp4
python -m benchmarks.lap_picture lap.mp4

deepracer-exp train observation=camera_small name=eye
deepracer-exp watch best:eye -o eye.mp4
python -m benchmarks.lap_picture eye.mp4 --still 3.3 --output docs/images/watch.png
"""

import argparse
from pathlib import Path

from imageio_ffmpeg import read_frames
from PIL import Image

OUTPUT = Path(__file__).parents[1] / "docs" / "images" / "lap.webp"
WIDTH, FRAMES_PER_S, QUALITY = 720, 15, 55


def main() -> None:
    """Write the picture and say how large it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("film", help="an .mp4 of `deepracer-exp evaluate --video` or `watch`")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument(
        "--still", type=float, metavar="S", help="write the frame at this second alone, a .png"
    )
    args = parser.parse_args()
    if args.still is not None:
        reader = read_frames(args.film, input_params=["-ss", str(args.still)])
        size = next(reader)["source_size"]
        Image.frombytes("RGB", size, next(reader)).save(args.output, optimize=True)
        print(f"{args.output}: {args.output.stat().st_size / 1e3:.0f} kB")
        return
    frames = moving_picture(args.film, args.output)
    print(f"{args.output}: {frames} frames, {args.output.stat().st_size / 1e6:.2f} MB")


def moving_picture(film: str, output: Path) -> int:
    """Write a film as an endless animated WebP of `WIDTH` pixels; returns its number of frames."""
    reader = read_frames(film, output_params=["-r", str(FRAMES_PER_S)])
    size = next(reader)["source_size"]
    height = round(size[1] * WIDTH / size[0])
    frames = [Image.frombytes("RGB", size, frame).resize((WIDTH, height)) for frame in reader]
    frames[0].save(
        output,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / FRAMES_PER_S),
        loop=0,
        quality=QUALITY,
        method=6,
    )
    return len(frames)


if __name__ == "__main__":
    main()
