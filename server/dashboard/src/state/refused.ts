// What the page says when the server refuses a draft, with the numbers that points have in the table.
import { Problem, sentence, describe } from '../api/client';
import { COORDINATE_MAX_M } from '../map/draft';
import type { Shape } from '../map/shape';
import { refusalOf, type Refusal } from '../refusal';
import { texts } from '../texts';
import { about } from '../units';

/** What an error says of a draft; null if it is no answer of the server. */
export function refusalIn(error: unknown, hasPoints: boolean, shape: Shape | null = null): Refusal | null {
  return error instanceof Problem && error.body ? refusalOf(error.body, hasPoints, shape) : null;
}

/** What went wrong, in the page's own words where it has some, else by the problem's type and the server's words. */
export function refusalText(error: unknown, hasPoints: boolean, shape: Shape | null = null): string {
  const refusal = refusalIn(error, hasPoints, shape);
  if (!refusal || !(error instanceof Problem) || !error.body) return sentence(error);
  const { refused } = texts.draw;
  const [first = NaN, second = NaN] = refusal.points;
  switch (refusal.kind) {
    case 'crosses':
      return refused.crosses(first, second);
    case 'same':
      return refused.same(first, second);
    case 'repeats':
      return refused.repeats(first);
    case 'tight':
      return refused.tight(first);
    case 'far':
      return refused.far(first, about('length', COORDINATE_MAX_M));
    case null:
      return describe({ ...error.body, detail: refusal.detail });
  }
}
