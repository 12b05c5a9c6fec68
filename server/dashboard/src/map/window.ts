// Which part of the friction map is read, and in which squares, for what can be seen of it. Pure.
import type { Bounds } from './camera';

/** A part of the map that is read. */
export interface Window {
  bounds: Bounds;
  /** Side of its squares, metres: the grid's times a power of two. */
  squareM: number;
}

/** How much more than what is seen is read to each side, so that a small move needs nothing. */
const BESIDE = 0.5;

/** The finest window around what is seen that has no more squares than this. */
export function windowOn(seen: Bounds, cellM: number, squaresMax: number): Window {
  const [width, height] = [seen.xMax - seen.xMin, seen.yMax - seen.yMin];
  let squareM = cellM;
  const count = (length: number) => Math.ceil((length * (1 + 2 * BESIDE)) / squareM) + 1;
  while (count(width) * count(height) > squaresMax) squareM *= 2;
  const down = (value: number) => Math.floor(value / squareM) * squareM;
  const up = (value: number) => Math.ceil(value / squareM) * squareM;
  return {
    bounds: {
      xMin: down(seen.xMin - BESIDE * width),
      yMin: down(seen.yMin - BESIDE * height),
      xMax: up(seen.xMax + BESIDE * width),
      yMax: up(seen.yMax + BESIDE * height),
    },
    squareM,
  };
}

/** Whether a window still serves what is seen: it holds all of it, as finely as it can be had. */
export function serves(window: Window, seen: Bounds, cellM: number, squaresMax: number): boolean {
  const { bounds } = window;
  return (
    bounds.xMin <= seen.xMin &&
    bounds.yMin <= seen.yMin &&
    bounds.xMax >= seen.xMax &&
    bounds.yMax >= seen.yMax &&
    window.squareM === windowOn(seen, cellM, squaresMax).squareM
  );
}
