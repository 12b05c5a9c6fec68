import { expect, test } from 'vitest';
import { about, estimate, exact, moment, number, short, span, unit, minute, momentOf } from './format';

test('what is not known is a dash', () => {
  expect([number(null, 1), short(undefined), span(NaN), number(Infinity, 2)]).toEqual(['–', '–', '–', '–']);
});

test('numbers have no negative zero and no grouping', () => {
  expect(number(-0.001, 2)).toBe('0.00');
  for (const digits of [0, 1, 2, 3]) {
    for (let exponent = 0; exponent < 8; exponent += 1) {
      for (const lead of [0.4999, 0.5, 0.51, 0.9999]) {
        const text = unit(-lead * 10 ** -exponent, digits, '%');
        expect(text, `${-lead * 10 ** -exponent} to ${digits}`).not.toMatch(/^-0(\.0*)? /);
      }
    }
  }
  expect([number(-0, 0), number(-0.5, 0), number(-0.05, 1), short(-1e-9)]).toEqual(['0', '-1', '-0.1', '0.000000']);
  expect(number(12_345.678, 1)).toBe('12345.7');
  expect([short(0.123456), short(12.3456), short(1234.5), short(0)]).toEqual(['0.123', '12.3', '1235', '0']);
});

test('spans are as short as they can be read', () => {
  expect([0.04, 9.96, 59, 61, 3_660, 90_000].map(span)).toEqual(['0.0 s', '10.0 s', '59 s', '1 min 1 s', '1 h 1 min', '1.0 d']);
});

test('moments have one format, with the offset for who asks', () => {
  const at = '2026-01-02T03:04:05Z';
  expect(moment(at)).toMatch(/^2026-01-0[123] \d\d:\d\d:05$/);
  expect(exact(at)).toMatch(/^2026-01-0[123]T\d\d:\d\d:05[+-]\d\d:\d\d \(.+\)$/);
  expect(Date.parse(exact(at).replace(/ \(.*/, ''))).toBe(Date.parse(at));
});

test('what is typed as a moment is read as it is shown, and nothing else is', () => {
  const at = new Date(2026, 0, 31, 14, 5).getTime();
  expect(minute(at)).toBe('2026-01-31 14:05');
  for (const text of [minute(at), ' 2026-1-31 14:05 ', '2026-01-31T14:05', '2026-01-31 14:05:00']) expect(momentOf(text), text).toBe(at);
  for (const text of ['', 'yesterday', '31.01.2026 14:05', '2026-02-31 14:05', '2026-01-31 24:05', '2026-01-31', '14:05']) {
    expect(momentOf(text), text).toBeNaN();
  }
});

test('estimates are short, and a time of day has its day where that is another one', () => {
  expect([3, 42, 61, 600, 3_700, 7_500].map(estimate)).toEqual(['5 s', '40 s', '1 min', '10 min', '1 h', '2 h 5 min']);
  const noon = new Date(2026, 0, 31, 12, 0, 0).getTime();
  expect([about(noon + 125_000, noon), about(noon + 86_400_000, noon)]).toEqual(['12:02', '2026-02-01 12:00']);
});
