// Lengths, speeds, masses and the like as they are shown. On the wire and in every state they are SI:
// they are converted where they are written, and where they are typed.
import { number, plain } from './format';
import type { System } from './locale';
import { roundUp } from './map/camera';
import { preferences } from './preferences.svelte';

/** Exact by definition. */
export const FOOT_M = 0.3048;
const INCH_M = FOOT_M / 12;
const POUND_KG = 0.45359237;
const POUND_FORCE_N = POUND_KG * 9.80665;
const MM_M = 0.001;

export type Kind = 'length' | 'offset' | 'area' | 'speed' | 'acceleration' | 'mass' | 'force';

interface Unit {
  symbol: string;
  /** One of it in SI units. */
  si: number;
  /** Digits more than of the metric unit, where it is much larger. */
  finer: number;
}

const unit = (symbol: string, si = 1, finer = 0): Unit => ({ symbol, si, finer });

/** An offset is a small length, such as an error of tracking. */
export const UNITS: Record<System, Record<Kind, Unit>> = {
  metric: {
    length: unit('m'),
    offset: unit('mm', MM_M),
    area: unit('m²'),
    speed: unit('m/s'),
    acceleration: unit('m/s²'),
    mass: unit('kg'),
    force: unit('N'),
  },
  imperial: {
    length: unit('ft', FOOT_M),
    offset: unit('in', INCH_M, 2),
    area: unit('ft²', FOOT_M ** 2),
    speed: unit('ft/s', FOOT_M),
    acceleration: unit('ft/s²', FOOT_M),
    mass: unit('lb', POUND_KG),
    force: unit('lbf', POUND_FORCE_N),
  },
};

const unitOf = (kind: Kind): Unit => UNITS[preferences.system][kind];

/** The symbol of the unit in which something is shown. */
export function symbol(kind: Kind): string {
  return unitOf(kind).symbol;
}

/** A value in the unit in which it is shown. */
export function inUnit(kind: Kind, si: number): number {
  return si / unitOf(kind).si;
}

/** A value in its unit, without the symbol. */
export function amount(kind: Kind, si: number | null | undefined, digits: number): string {
  const { finer } = unitOf(kind);
  return number(si === null || si === undefined ? si : inUnit(kind, si), digits + finer);
}

/** A value with its unit, with a fixed count of digits. */
export function measure(kind: Kind, si: number | null | undefined, digits: number): string {
  const text = amount(kind, si, digits);
  const isKnown = si !== null && si !== undefined && Number.isFinite(si);
  return isKnown ? `${text} ${symbol(kind)}` : text;
}

/** A value with its unit, with three significant digits at most. */
export function about(kind: Kind, si: number): string {
  return `${plain(inUnit(kind, si))} ${symbol(kind)}`;
}

/** Digits of a field after its point: finer than anybody can drive. */
const FIELD_DIGITS = 4;

/** A value as a field shows it; what is no number is an empty field. */
export function inField(kind: Kind, si: number | null | undefined, system: System = preferences.system): number | null {
  if (si === null || si === undefined || !Number.isFinite(si)) return null;
  const unit = UNITS[system][kind];
  // Metres are shown as they are.
  return unit.si === 1 ? si : Number((si / unit.si).toFixed(FIELD_DIGITS));
}

/**
 * What was typed into a field, in SI units; NaN for an empty one. A value of which the field shows just
 * that is meant exactly: what is shown and typed again does not change.
 */
export function fromField(
  kind: Kind,
  typed: number | null | undefined,
  known: readonly (number | null | undefined)[] = [],
  system: System = preferences.system,
): number {
  if (typed === null || typed === undefined || !Number.isFinite(typed)) return NaN;
  const same = known.find((si) => inField(kind, si, system) === typed);
  return same ?? exact(typed * UNITS[system][kind].si);
}

/** Without the noise of binary fractions: to the nanometre. */
function exact(si: number): number {
  return Number(si.toFixed(9));
}

/** A round step of lines or marks that is at least so long, metres. */
export function stepM(least_m: number): number {
  const { si } = unitOf('length');
  return roundUp(least_m / si) * si;
}

/** A round length that is at least so long, as a scale bar has it. */
export function scaleBar(least_m: number): { length_m: number; text: string } {
  const isMetric = preferences.system === 'metric';
  const least = inUnit('length', least_m);
  const length = roundUp(least);
  if (length >= 1) return { length_m: length * unitOf('length').si, text: `${plain(length)} ${symbol('length')}` };
  if (isMetric && length >= 0.01) return { length_m: length, text: `${Math.round(length * 100)} cm` };
  const small = roundUp(inUnit('offset', least_m));
  return { length_m: small * unitOf('offset').si, text: `${plain(small)} ${symbol('offset')}` };
}
