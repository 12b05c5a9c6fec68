// Colours of the map, for light and dark.
import type { TerrainClass } from '../api/schema';
import type { Theme } from '../state/session.svelte';

export interface Palette {
  ground: string;
  grid: string;
  gridStrong: string;
  text: string;
  halo: string;
  robot: string;
  robotLate: string;
  robotLost: string;
  stopped: string;
  fault: string;
  selected: string;
  trail: string;
  planned: string;
  driven: string;
  fence: string;
  fenceOut: string;
  draft: string;
  draftFill: string;
}

export const PALETTES: Record<Theme, Palette> = {
  light: {
    ground: '#f4f5f2',
    grid: '#e2e4de',
    gridStrong: '#c3c7bd',
    text: '#1b2328',
    halo: '#f4f5f2',
    robot: '#0b5fa5',
    robotLate: '#8a5a00',
    robotLost: '#5d666b',
    stopped: '#b3121d',
    fault: '#b3121d',
    selected: '#111111',
    trail: '#5f93c2',
    planned: '#7a2e9d',
    driven: '#0b5fa5',
    fence: '#1a7f37',
    fenceOut: '#b3121d',
    draft: '#c2410c',
    draftFill: 'rgba(194, 65, 12, 0.12)',
  },
  dark: {
    ground: '#14191d',
    grid: '#1f262b',
    gridStrong: '#344049',
    text: '#e6ebee',
    halo: '#14191d',
    robot: '#6cb6f5',
    robotLate: '#e0a93b',
    robotLost: '#93a0a8',
    stopped: '#ff6b6b',
    fault: '#ff6b6b',
    selected: '#ffffff',
    trail: '#4a82b3',
    planned: '#d59bf6',
    driven: '#6cb6f5',
    fence: '#56d37c',
    fenceOut: '#ff6b6b',
    draft: '#ff9d5c',
    draftFill: 'rgba(255, 157, 92, 0.15)',
  },
};

/** Most saturation of ground, percent: colours belong to the scale of the friction layer. */
export const GROUND_SATURATION_MAX = 8;

/** Hue, saturation and lightness of each kind of ground: greys that differ by their lightness. */
const GROUNDS: Record<TerrainClass, [number, number, number]> = {
  asphalt: [220, 3, 52],
  concrete: [210, 4, 72],
  paving: [20, 4, 68],
  gravel: [30, 4, 62],
  soil: [25, 8, 50],
  grass: [105, 8, 66],
  sand: [45, 8, 80],
  mud: [20, 6, 44],
  snow: [210, 8, 95],
  ice: [200, 8, 88],
  wood: [30, 8, 58],
  metal: [215, 6, 76],
  other: [0, 0, 70],
};

export function groundFill(kind: TerrainClass, theme: Theme): string {
  const [hue, saturation, lightness] = GROUNDS[kind];
  return theme === 'dark'
    ? `hsl(${hue} ${saturation}% ${lightness * 0.42}% / 0.6)`
    : `hsl(${hue} ${saturation}% ${lightness}% / 0.6)`;
}

export function groundLine(kind: TerrainClass, theme: Theme): string {
  const [hue, saturation] = GROUNDS[kind];
  return theme === 'dark' ? `hsl(${hue} ${saturation}% 50%)` : `hsl(${hue} ${saturation}% 45%)`;
}
