import { expect, test } from 'vitest';
import { languageOf, localeOf, systemOf } from './locale';

test('the language is the first that the browser asks for and that there is', () => {
  expect(languageOf(['de-AT', 'en'])).toBe('de');
  expect(languageOf(['fr-CA', 'de', 'en'])).toBe('de');
  expect(languageOf(['en-US', 'de'])).toBe('en');
  expect([languageOf(['fr']), languageOf([]), languageOf(['den'])]).toEqual(['en', 'en', 'en']);
});

test('numbers are written as in the region that the browser names, if its language is the chosen one', () => {
  expect(localeOf('de', ['en-US', 'de-CH'])).toBe('de-CH');
  expect(localeOf('de', ['en-US'])).toBe('de');
});

test('units are imperial in the United States, and metric where no region is named', () => {
  expect(systemOf(['en-US', 'en'])).toBe('imperial');
  expect(systemOf(['en', 'en-US'])).toBe('imperial');
  expect(['de-DE', 'en-GB', 'en', 'de'].map((locale) => systemOf([locale]))).toEqual(Array(4).fill('metric'));
  expect(systemOf(['de-DE', 'en-US'])).toBe('metric');
  expect(systemOf(['not a locale'])).toBe('metric');
});
