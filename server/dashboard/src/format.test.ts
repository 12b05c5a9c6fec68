import { expect, test } from 'vitest';
import { number, short, span } from './format';

test('what is not known is a dash', () => {
  expect([number(null, 1), short(undefined), span(NaN), number(Infinity, 2)]).toEqual(['–', '–', '–', '–']);
});

test('numbers have no negative zero and no grouping', () => {
  expect(number(-0.001, 2)).toBe('0.00');
  expect(number(12_345.678, 1)).toBe('12345.7');
  expect([short(0.123456), short(12.3456), short(1234.5), short(0)]).toEqual(['0.123', '12.3', '1235', '0']);
});

test('spans are as short as they can be read', () => {
  expect([0.04, 9.96, 59, 61, 3_660, 90_000].map(span)).toEqual(['0.0 s', '10.0 s', '59 s', '1 min 1 s', '1 h 1 min', '1.0 d']);
});
