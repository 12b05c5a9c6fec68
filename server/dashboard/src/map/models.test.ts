import { expect, test } from 'vitest';
import { modelLabel } from './models';

test('a model is named with its tyres only where another one has the same name', () => {
  const models: Record<string, { name: string; tyres: string }> = {
    a: { name: 'rover', tyres: 'standard' },
    b: { name: 'rover', tyres: 'studded' },
    c: { name: 'carrier', tyres: 'standard' },
  };
  const all = ['a', 'b', 'c', '0123456789'];
  const labels = all.map((one) => modelLabel(one, all, (other) => models[other] ?? null));
  // What no robot of the site has is named by its identifier.
  expect(labels).toEqual(['rover, standard', 'rover, studded', 'carrier', '01234567']);
});
