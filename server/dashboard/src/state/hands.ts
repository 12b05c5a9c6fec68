// What hands on keys and sticks want. Pure.

/** Stick positions of a gamepad that count as its middle. */
const DEAD_ZONE = 0.12;

/** What the hands want, each −1 to 1: forwards, and to the left. */
export interface Wish {
  forward: number;
  left: number;
}

export const KEYS: Record<string, [keyof Wish, number]> = {
  KeyW: ['forward', 1],
  ArrowUp: ['forward', 1],
  KeyS: ['forward', -1],
  ArrowDown: ['forward', -1],
  KeyA: ['left', 1],
  ArrowLeft: ['left', 1],
  KeyD: ['left', -1],
  ArrowRight: ['left', -1],
};

/** What pressed keys want. */
export function wishOfKeys(pressed: ReadonlySet<string>): Wish {
  const wish: Wish = { forward: 0, left: 0 };
  for (const code of pressed) {
    const key = KEYS[code];
    if (key) wish[key[0]] += key[1];
  }
  return clamped(wish);
}

/** What a stick of a gamepad wants: its axes grow to the right and backwards. */
export function wishOfAxes(x: number, y: number): Wish {
  const live = (value: number) => (Math.abs(value) < DEAD_ZONE ? 0 : value);
  return clamped({ forward: -live(y) || 0, left: -live(x) || 0 });
}

export function clamped(wish: Wish): Wish {
  const bound = (value: number) => Math.min(1, Math.max(-1, value));
  return { forward: bound(wish.forward), left: bound(wish.left) };
}
