import { expect, test } from 'vitest';
import { inputOfAxes, inputOfKeys } from './drive_input';

test('keys that oppose each other cancel, and two for the same do not add up', () => {
  expect(inputOfKeys(new Set(['KeyW', 'KeyS']))).toEqual({ forward: 0, left: 0 });
  expect(inputOfKeys(new Set(['KeyW', 'ArrowUp', 'KeyD']))).toEqual({ forward: 1, left: -1 });
  expect(inputOfKeys(new Set(['KeyQ']))).toEqual({ forward: 0, left: 0 });
});

test('a stick near its middle wants nothing, and beyond its end no more than everything', () => {
  expect(inputOfAxes(0.1, -0.1)).toEqual({ forward: 0, left: 0 });
  expect(inputOfAxes(-2, -3)).toEqual({ forward: 1, left: 1 });
  expect(inputOfAxes(0.5, 0.5)).toEqual({ forward: -0.5, left: -0.5 });
});
