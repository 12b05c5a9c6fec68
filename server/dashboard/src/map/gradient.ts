// A colour map as a background of the page. Pure.
import type { Rgb } from './single_hue';

/** Colours that are stated; the browser mixes those between them. */
const STOPS = 32;

/** A CSS gradient from left to right. */
export function gradient(colourAt: (share: number) => Rgb): string {
  const stops = Array.from({ length: STOPS + 1 }, (_, step) => `rgb(${colourAt(step / STOPS).join(' ')})`);
  return `linear-gradient(to right, ${stops.join(', ')})`;
}
