// How θ of a terrain or of a cell went over time, as the server says it.
import type { FrictionAt, FusedFriction, ModelFriction, PointHistory, TerrainHistory } from '../api/schema';
import { ask } from '../api/client';
import type { PointM } from '../map/camera';
import { momentsOf, stepS, type Span } from '../map/moments';
import { serverClock } from '../server_clock';

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
  const path = `/v1/sites/${site}/friction/terrains/${terrain}/history?${timesOf(span)}`;
  const { items } = await ask<TerrainHistory>(path);
  return knownOf(items, configuration);
}

/** Of the cell at a point, on the terrain there. */
export async function cellHistory(
  site: string,
  at: PointM,
  configuration: string | null,
  span: Span,
): Promise<Known[]> {
  const query = timesOf(span);
  query.set('x_m', String(at.x_m));
  query.set('y_m', String(at.y_m));
  const { items } = await ask<PointHistory>(`/v1/sites/${site}/friction/point/history?${query}`);
  return knownOf(items, configuration);
}

/** The times of a span up to the server's present. */
function timesOf(span: Span): URLSearchParams {
  const first_ms = momentsOf(span, serverClock.now())[0] ?? 0;
  return new URLSearchParams({ from: new Date(first_ms).toISOString(), step_s: String(stepS(span)) });
}

function knownOf(items: FrictionAt[], configuration: string | null): Known[] {
  return items.map(({ as_of, models }) => ({ at_ms: Date.parse(as_of), friction: ofModel(models, configuration) }));
}

function ofModel(models: ModelFriction[], configuration: string | null): FusedFriction | null {
  const model = models.find((entry) => !configuration || entry.configuration === configuration);
  return model?.friction ?? null;
}
