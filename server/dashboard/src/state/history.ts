// How θ of a terrain or of a cell went over time, as the server says it.
import type { FusedFriction, ModelFriction, PointFriction, TerrainHistory } from '../api/schema';
import { ask } from '../api/client';
import type { PointM } from '../map/camera';
import { momentsOf, stepS, thinned, type Span } from '../map/moments';

/** Requests for the history of a cell at once. */
const AT_ONCE = 4;

/** Friction at one time; null where it was unknown then. */
export interface Known {
  at_ms: number;
  friction: FusedFriction | null;
}

export async function terrainHistory(
  site: string,
  terrain: string,
  configuration: string | null,
  span: Span,
): Promise<Known[]> {
  const first_ms = momentsOf(span, Date.now())[0] ?? 0;
  const query = new URLSearchParams({ from: new Date(first_ms).toISOString(), step_s: String(stepS(span)) });
  const path = `/v1/sites/${site}/friction/terrains/${terrain}/history?${query}`;
  const { items } = await ask<TerrainHistory>(path);
  return items.map(({ as_of, models }) => ({ at_ms: Date.parse(as_of), friction: ofModel(models, configuration) }));
}

/** The API has no history of a cell: it is asked for at each time. */
export async function cellHistory(
  site: string,
  at: PointM,
  configuration: string | null,
  span: Span,
): Promise<Known[]> {
  const moments: (number | null)[] = [...thinned(momentsOf(span, Date.now())), null];
  const known: Known[] = [];
  const one = async (at_ms: number | null, index: number) => {
    const query = new URLSearchParams({ x_m: String(at.x_m), y_m: String(at.y_m) });
    if (at_ms !== null) query.set('as_of', new Date(at_ms).toISOString());
    const point = await ask<PointFriction>(`/v1/sites/${site}/friction/point?${query}`);
    known[index] = { at_ms: at_ms ?? Date.now(), friction: ofModel(point.models, configuration) };
  };
  for (let begin = 0; begin < moments.length; begin += AT_ONCE) {
    const some = moments.slice(begin, begin + AT_ONCE);
    await Promise.all(some.map((at_ms, index) => one(at_ms, begin + index)));
  }
  return known;
}

function ofModel(models: ModelFriction[], configuration: string | null): FusedFriction | null {
  const model = models.find((entry) => !configuration || entry.configuration === configuration);
  return model?.friction ?? null;
}
