// Cells of a grid as an image, with those that are to be hatched.
import type { Cell } from '../api/schema';
import type { Bounds, PointM } from './camera';

/** More cells than any site has along one side; its square is still a whole number. */
const KEY_SPAN = 2 ** 26;
/** Most cells along one side of the image. */
const SIDE_MAX = 2_048;

/** What a cell looks like. */
export interface Look {
  colour: [number, number, number];
  hatch: Hatch;
}

/** How densely a cell is hatched: 0 is not at all. */
export type Hatch = 0 | 1 | 2 | 3;

export class Raster<T extends { cell: Cell }> {
  readonly cells = new Map<number, T>();
  image: HTMLCanvasElement | null = null;
  /** What the image covers, metres. */
  bounds: Bounds | null = null;
  /** Cells of each density of hatching, from 1 on. */
  readonly hatched: [T[], T[], T[]] = [[], [], []];

  constructor(
    cells: readonly T[],
    readonly cellM: number,
    /** Whether another entry of the same square is shown rather than the one that is known. */
    isBetter: (known: T, other: T) => boolean,
  ) {
    for (const cell of cells) {
      const key = keyOf(cell.cell.ix, cell.cell.iy);
      const known = this.cells.get(key);
      if (!known || isBetter(known, cell)) this.cells.set(key, cell);
    }
  }

  at(point: PointM): T | null {
    const key = keyOf(Math.floor(point.x_m / this.cellM), Math.floor(point.y_m / this.cellM));
    return this.cells.get(key) ?? null;
  }

  /** Paints each cell as it looks; those without a look are left out. */
  protected paint(look: (cell: T) => Look | null): void {
    const cells = [...this.cells.values()];
    if (cells.length === 0) return;
    let [xMin, yMin, xMax, yMax] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { cell } of cells) {
      xMin = Math.min(xMin, cell.ix);
      yMin = Math.min(yMin, cell.iy);
      xMax = Math.max(xMax, cell.ix);
      yMax = Math.max(yMax, cell.iy);
    }
    const width = Math.min(SIDE_MAX, xMax - xMin + 1);
    const height = Math.min(SIDE_MAX, yMax - yMin + 1);
    const canvas = document.createElement('canvas');
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext('2d');
    if (!context) return;
    const pixels = context.createImageData(width, height);
    for (const cell of cells) {
      const [column, row] = [cell.cell.ix - xMin, yMin + height - 1 - cell.cell.iy];
      if (column >= width || row < 0) continue;
      const shown = look(cell);
      if (!shown) continue;
      pixels.data.set([...shown.colour, 255], (row * width + column) * 4);
      if (shown.hatch > 0) this.hatched[shown.hatch - 1]?.push(cell);
    }
    context.putImageData(pixels, 0, 0);
    this.image = canvas;
    this.bounds = {
      xMin: xMin * this.cellM,
      yMin: yMin * this.cellM,
      xMax: (xMin + width) * this.cellM,
      yMax: (yMin + height) * this.cellM,
    };
  }
}

/** Both in one number, which takes a fraction of the room and time of a text. */
function keyOf(ix: number, iy: number): number {
  return ix * KEY_SPAN + iy;
}
