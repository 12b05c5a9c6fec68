// Draws a layer of cells: its image, and hatching over those that are unsure.
import type { Camera } from './camera';
import type { Cell } from '../api/schema';
import type { Raster } from './raster';

/** Least pixels of a cell's side for hatching to be read. */
export const HATCHED_CELL_PX = 8;
/** Distance of the lines of the hatching, pixels. */
const LINE_PX = 5;

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
  context.beginPath();
  for (const { cell } of layer.hatched) {
    const x_m = cell.ix * layer.cellM;
    const y_m = (cell.iy + 1) * layer.cellM;
    if (x_m > seen.xMax || x_m + layer.cellM < seen.xMin) continue;
    if (y_m - layer.cellM > seen.yMax || y_m < seen.yMin) continue;
    const { x, y } = camera.toPx({ x_m, y_m });
    for (let at = LINE_PX; at < 2 * side; at += LINE_PX) {
      context.moveTo(x + Math.max(0, at - side), y + Math.min(at, side));
      context.lineTo(x + Math.min(at, side), y + Math.max(0, at - side));
    }
  }
  context.lineWidth = 1;
  context.strokeStyle = 'rgba(255, 255, 255, 0.65)';
  context.stroke();
}
