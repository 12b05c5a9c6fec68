// Speed and turn that an operator commands with keys or a stick. Pure.

/** Stick positions of a gamepad that count as its middle. */
const DEAD_ZONE = 0.12;

/** Commanded motion, each −1 to 1: forwards, and to the left. */
export interface DriveInput {
  forward: number;
  left: number;
}

export const KEYS: Record<string, [keyof DriveInput, number]> = {
  KeyW: ['forward', 1],
  ArrowUp: ['forward', 1],
  KeyS: ['forward', -1],
  ArrowDown: ['forward', -1],
  KeyA: ['left', 1],
  ArrowLeft: ['left', 1],
  KeyD: ['left', -1],
  ArrowRight: ['left', -1],
};

/** Motion that pressed keys command. */
export function inputOfKeys(pressed: ReadonlySet<string>): DriveInput {
  const input: DriveInput = { forward: 0, left: 0 };
  for (const code of pressed) {
    const key = KEYS[code];
    if (key) input[key[0]] += key[1];
  }
  return clamped(input);
}

/** Motion that a gamepad's stick commands: its axes grow to the right and backwards. */
export function inputOfAxes(x: number, y: number): DriveInput {
  const live = (value: number) => (Math.abs(value) < DEAD_ZONE ? 0 : value);
  return clamped({ forward: -live(y) || 0, left: -live(x) || 0 });
}

export function clamped(input: DriveInput): DriveInput {
  const bound = (value: number) => Math.min(1, Math.max(-1, value));
  return { forward: bound(input.forward), left: bound(input.left) };
}
