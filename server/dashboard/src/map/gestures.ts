// Pointers on the map: one finger or the mouse draws or moves, two fingers zoom, the wheel zooms.
import type { Camera, PointPx } from './camera';
import type { Draft } from './draft';

/** A press that moves less than this is a click, pixels. */
const CLICK_PX = 5;
/** How near a point must be to be taken, pixels; fingers are wider than this says. */
const REACH_PX = 14;
/** How long a finger rests on a point to delete it, milliseconds. */
const LONG_PRESS_MS = 550;
/** A finger that moves less than this rests, pixels. */
const REST_PX = 10;
/** Factor of one step of the wheel, per pixel. */
const WHEEL_FACTOR = 0.0015;

export interface GestureHandlers {
  draft(): Draft | null;
  changed(): void;
  /** The camera moved. */
  moved(): void;
  /** A click where nothing is drawn; with Ctrl or Shift it means more than one. */
  clicked(at: PointPx, isMore: boolean): void;
  /** The pointer is here; null when it left. */
  over(at: PointPx | null): void;
}

type Drag =
  | { what: 'press'; from: PointPx; at: PointPx }
  | { what: 'pan'; at: PointPx }
  | { what: 'point'; index: number; from: PointPx }
  | { what: 'circle'; from: PointPx };

/** Calls handlers for gestures of mouse and fingers on a canvas; returns what detaches them. */
export function attach(canvas: HTMLCanvasElement, camera: Camera, handlers: GestureHandlers): () => void {
  const pointers = new Map<number, PointPx>();
  let drag: Drag | null = null;

  const place = (event: MouseEvent): PointPx => {
    const box = canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  };

  const down = (event: PointerEvent) => {
    if (event.button !== 0) return;
    const at = place(event);
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at);
    if (pointers.size > 1) {
      clearTimeout(resting);
      drag = null;
      return;
    }
    const draft = handlers.draft();
    const near = draft && draft.kind !== 'circle' ? draft.nearest(camera.toM(at), REACH_PX / camera.scale) : null;
    if (draft && near !== null) {
      draft.mark();
      drag = { what: 'point', index: near, from: at };
      if (event.pointerType === 'touch') rest(draft, near);
    } else if (draft?.kind === 'circle') {
      drag = { what: 'circle', from: at };
    } else {
      drag = { what: 'press', from: at, at };
    }
  };

  let resting: ReturnType<typeof setTimeout> | undefined;
  /** Browsers also say of some long presses that a menu is wanted. */
  let wasLongPress = false;
  const rest = (draft: Draft, index: number) => {
    wasLongPress = false;
    clearTimeout(resting);
    resting = setTimeout(() => {
      if (drag?.what !== 'point' || handlers.draft() !== draft) return;
      drag = null;
      wasLongPress = true;
      // Where it was before the finger trembled.
      draft.undo();
      draft.remove(index);
      handlers.changed();
    }, LONG_PRESS_MS);
  };

  const move = (event: PointerEvent) => {
    const at = place(event);
    handlers.over(at);
    const before = pointers.get(event.pointerId);
    if (!before) return;
    pointers.set(event.pointerId, at);
    if (pointers.size === 2) {
      pinch(event.pointerId, before, at);
      return;
    }
    const draft = handlers.draft();
    if (drag?.what === 'press' && distance(drag.from, at) > CLICK_PX) drag = { what: 'pan', at: drag.from };
    if (drag?.what === 'pan') {
      camera.pan(at.x - drag.at.x, at.y - drag.at.y);
      drag.at = at;
      handlers.moved();
    } else if (drag?.what === 'point' && draft) {
      if (distance(drag.from, at) > REST_PX) clearTimeout(resting);
      draft.move(drag.index, camera.toM(at));
      handlers.changed();
    } else if (drag?.what === 'circle' && draft && distance(drag.from, at) > CLICK_PX) {
      drawCircle(draft, drag.from, at);
    }
  };

  let isDrawing = false;
  const drawCircle = (draft: Draft, from: PointPx, to: PointPx) => {
    if (!isDrawing) draft.mark();
    isDrawing = true;
    draft.setCircle(camera.toM(from), distance(from, to) / camera.scale);
    handlers.changed();
  };

  const pinch = (moved: number, before: PointPx, at: PointPx) => {
    const other = [...pointers.entries()].find(([id]) => id !== moved)?.[1];
    if (!other) return;
    const was = distance(before, other);
    const is = distance(at, other);
    camera.pan((at.x - before.x) / 2, (at.y - before.y) / 2);
    if (was > 1 && is > 1) camera.zoom(is / was, { x: (at.x + other.x) / 2, y: (at.y + other.y) / 2 });
    handlers.moved();
  };

  const up = (event: PointerEvent) => {
    const held = drag;
    clearTimeout(resting);
    pointers.delete(event.pointerId);
    isDrawing = false;
    drag = null;
    if (held?.what !== 'press') return;
    const draft = handlers.draft();
    if (draft && draft.kind !== 'circle') {
      draft.add(camera.toM(held.from));
      handlers.changed();
    } else {
      handlers.clicked(held.from, event.ctrlKey || event.metaKey || event.shiftKey);
    }
  };

  const cancel = (event: PointerEvent) => {
    clearTimeout(resting);
    pointers.delete(event.pointerId);
    isDrawing = false;
    drag = null;
  };

  const wheel = (event: WheelEvent) => {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
    camera.zoom(Math.exp(-event.deltaY * lines * WHEEL_FACTOR), place(event));
    handlers.moved();
  };

  const menu = (event: MouseEvent) => {
    const draft = handlers.draft();
    if (!draft) return;
    event.preventDefault();
    if (wasLongPress) {
      wasLongPress = false;
      return;
    }
    const near = draft.nearest(camera.toM(place(event)), REACH_PX / camera.scale);
    if (near === null || draft.kind === 'circle') return;
    draft.remove(near);
    handlers.changed();
  };

  const leave = () => handlers.over(null);

  canvas.addEventListener('pointerdown', down);
  canvas.addEventListener('pointermove', move);
  canvas.addEventListener('pointerup', up);
  canvas.addEventListener('pointercancel', cancel);
  canvas.addEventListener('pointerleave', leave);
  canvas.addEventListener('wheel', wheel, { passive: false });
  canvas.addEventListener('contextmenu', menu);
  return () => {
    clearTimeout(resting);
    canvas.removeEventListener('pointerdown', down);
    canvas.removeEventListener('pointermove', move);
    canvas.removeEventListener('pointerup', up);
    canvas.removeEventListener('pointercancel', cancel);
    canvas.removeEventListener('pointerleave', leave);
    canvas.removeEventListener('wheel', wheel);
    canvas.removeEventListener('contextmenu', menu);
  };
}

function distance(a: PointPx, b: PointPx): number {
  return Math.hypot(a.x - b.x, a.y - b.y);
}
