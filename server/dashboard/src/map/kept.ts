// A part of the map that takes most of a frame to draw: it is drawn anew only so often, and copied meanwhile.
import type { Camera, PointM } from './camera';

export class Kept {
  readonly #layer = document.createElement('canvas').getContext('2d');
  /** When it was drawn, and for which part of the map. */
  #drawn: { now: number; center: PointM; scale: number } | null = null;

  constructor(
    /** Time between two times that it is drawn anew, milliseconds. */
    readonly anewMs: number,
  ) {}

  /** Shows it on the map, by `draw` if that is due; true if what is shown was drawn before, and may have changed. */
  show(context: CanvasRenderingContext2D, camera: Camera, now: number, draw: (to: CanvasRenderingContext2D) => void): boolean {
    const layer = this.#layer;
    if (!layer) {
      draw(context);
      return false;
    }
    const { width, height } = context.canvas;
    const isSized = layer.canvas.width === width && layer.canvas.height === height;
    const drawn = this.#drawn;
    if (drawn && isSized && drawn.scale === camera.scale && now - drawn.now < this.anewMs) {
      // In whole pixels, so that letters stay sharp.
      const x = Math.round((drawn.center.x_m - camera.center.x_m) * camera.scale);
      const y = Math.round((camera.center.y_m - drawn.center.y_m) * camera.scale);
      context.drawImage(layer.canvas, x, y, camera.width, camera.height);
      return true;
    }
    if (!isSized) Object.assign(layer.canvas, { width, height });
    layer.setTransform(1, 0, 0, 1, 0, 0);
    layer.clearRect(0, 0, width, height);
    layer.setTransform(context.getTransform());
    draw(layer);
    this.#drawn = { now, center: { ...camera.center }, scale: camera.scale };
    context.drawImage(layer.canvas, 0, 0, camera.width, camera.height);
    return false;
  }
}
