// Colour maps of one hue each, from pale to deep: for what is no slip, which cividis is kept for.

export type Rgb = [number, number, number];

/** Pale, middle and deep. */
type Hue = readonly [Rgb, Rgb, Rgb];

const TEAL: Hue = [
  [214, 238, 233],
  [74, 160, 150],
  [0, 62, 60],
];
const SLATE: Hue = [
  [200, 211, 232],
  [112, 135, 172],
  [32, 48, 84],
];

function along([pale, middle, deep]: Hue, share: number): Rgb {
  const at = Math.min(1, Math.max(0, share)) * 2;
  const [from, to, part] = at < 1 ? [pale, middle, at] : [middle, deep, at - 1];
  const mix = (index: 0 | 1 | 2) => Math.round(from[index] + part * (to[index] - from[index]));
  return [mix(0), mix(1), mix(2)];
}

/** For friction that was used: deep is much. */
export const teal = (share: number): Rgb => along(TEAL, share);
/** For how well a place is known: deep is new, or often measured. */
export const slate = (share: number): Rgb => along(SLATE, share);
