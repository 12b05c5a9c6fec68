// Draws a layer of cells: its image, and hatching over those that are unsure.
import type { Camera, PointM } from './camera';
import type { Cell } from '../api/schema';
import type { Palette } from './palette';
import type { Raster } from './raster';

/** Least pixels of a cell's side for hatching to be read. */
export const HATCHED_CELL_PX = 3;
/** Distance of the lines of each density, pixels along the edge. */
const LINES_PX = [11, 7, 4] as const;
/** The tile of a pattern is drawn so much finer, for screens with small pixels. */
const FINE = 2;

const patterns: (CanvasPattern | null)[] = [];

/** Diagonal lines, light with a dark edge, so that they are seen on every colour of the scale. */
export function hatching(context: CanvasRenderingContext2D, density: 1 | 2 | 3): CanvasPattern | null {
  const known = patterns[density];
  if (known !== undefined) return known;
  const side = LINES_PX[density - 1] ?? LINES_PX[0];
  const tile = document.createElement('canvas');
  tile.width = side * FINE;
  tile.height = side * FINE;
  const brush = tile.getContext('2d');
  if (!brush) return null;
  brush.scale(FINE, FINE);
  for (const [colour, width, offset] of [
    ['rgba(0, 0, 0, 0.55)', 0.9, 0.9],
    ['rgba(255, 255, 255, 0.9)', 0.9, 0],
  ] as const) {
    brush.beginPath();
    // The neighbours' lines too, whose ends lie in this tile.
    for (const shift of [-side, 0, side]) {
      brush.moveTo(shift - 1 + offset, side + 1);
      brush.lineTo(shift + side + 1 + offset, -1);
    }
    brush.lineWidth = width;
    brush.strokeStyle = colour;
    brush.stroke();
  }
  const pattern = context.createPattern(tile, 'repeat');
  pattern?.setTransform(new DOMMatrix().scale(1 / FINE));
  patterns[density] = pattern;
  return pattern;
}

export function drawFriction(context: CanvasRenderingContext2D, camera: Camera, layer: Raster<{ cell: Cell }>): void {
  const { image, bounds } = layer;
  if (!image || !bounds) return;
  const corner = camera.toPx({ x_m: bounds.xMin, y_m: bounds.yMax });
  const width = (bounds.xMax - bounds.xMin) * camera.scale;
  const height = (bounds.yMax - bounds.yMin) * camera.scale;
  context.imageSmoothingEnabled = false;
  context.drawImage(image, corner.x, corner.y, width, height);
  const side = layer.cellM * camera.scale;
  if (side < HATCHED_CELL_PX) return;
  const seen = camera.bounds;
  for (const density of [1, 2, 3] as const) {
    const cells = layer.hatched[density - 1] ?? [];
    const pattern = cells.length > 0 ? hatching(context, density) : null;
    if (!pattern) continue;
    context.beginPath();
    for (const { cell } of cells) {
      const x_m = cell.ix * layer.cellM;
      const y_m = (cell.iy + 1) * layer.cellM;
      if (x_m > seen.xMax || x_m + layer.cellM < seen.xMin) continue;
      if (y_m - layer.cellM > seen.yMax || y_m < seen.yMin) continue;
      const { x, y } = camera.toPx({ x_m, y_m });
      context.rect(x, y, side, side);
    }
    context.fillStyle = pattern;
    context.fill();
  }
}

/** A frame around the cell that is looked at. */
export function drawInspected(
  context: CanvasRenderingContext2D,
  camera: Camera,
  at: PointM,
  cellM: number,
  palette: Palette,
): void {
  const corner = { x_m: Math.floor(at.x_m / cellM) * cellM, y_m: (Math.floor(at.y_m / cellM) + 1) * cellM };
  const { x, y } = camera.toPx(corner);
  const side = Math.max(4, cellM * camera.scale);
  for (const [width, colour] of [
    [4, palette.halo],
    [2, palette.selected],
  ] as const) {
    context.lineWidth = width;
    context.strokeStyle = colour;
    context.strokeRect(x, y, side, side);
  }
}
