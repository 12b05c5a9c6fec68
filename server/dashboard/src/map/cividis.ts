// The colour map cividis: even in brightness for all eyes, and in grey.
// The polynomials are those of d3-scale-chromatic (ISC), fitted to the published table.

/** Colours of the table. */
export const STEPS = 256;

function channels(t: number): [number, number, number] {
  return [
    -4.54 - t * (35.34 - t * (2381.73 - t * (6402.7 - t * (7024.72 - t * 2710.57)))),
    32.49 + t * (170.73 + t * (52.82 - t * (131.46 - t * (176.58 - t * 67.37)))),
    81.24 + t * (442.36 - t * (2482.43 - t * (6167.24 - t * (6614.94 - t * 2475.67)))),
  ];
}

/** The colours, three bytes each; the array itself rounds and clamps. */
export const CIVIDIS = Uint8ClampedArray.from(
  Array.from({ length: STEPS }, (_, step) => channels(step / (STEPS - 1))).flat(),
);

/** The colour of a share from 0 to 1. */
export function colour(share: number): [number, number, number] {
  const step = Math.round(Math.min(1, Math.max(0, share)) * (STEPS - 1)) * 3;
  return [CIVIDIS[step] ?? 0, CIVIDIS[step + 1] ?? 0, CIVIDIS[step + 2] ?? 0];
}
