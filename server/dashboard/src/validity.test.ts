import { afterEach, beforeEach, expect, test, vi } from 'vitest';
import { preferences } from './preferences.svelte';
import { DICTIONARIES } from './texts';
import { flawOf, speakForFields } from './validity';

beforeEach(() => {
  vi.stubGlobal('localStorage', { setItem: () => undefined });
  vi.stubGlobal('document', { documentElement: {} });
});
afterEach(() => {
  preferences.language = 'en';
  vi.unstubAllGlobals();
});

const field = (validity: Partial<ValidityState>) => ({ validity, min: '0.05', max: '1000', title: 'lower-case letters' });

test('each flaw of a field is a sentence in the language of the page', () => {
  const flaws = ['valueMissing', 'badInput', 'typeMismatch', 'patternMismatch', 'rangeUnderflow', 'rangeOverflow', 'stepMismatch', 'customError'] as const;
  for (const language of ['en', 'de'] as const) {
    preferences.language = language;
    const said = flaws.map((flaw) => flawOf(field({ [flaw]: true })));
    expect(new Set(said).size).toBe(flaws.length);
    expect(said[0]).toBe(DICTIONARIES[language].form.missing);
    for (const sentence of said) expect(sentence).toMatch(/^\p{Lu}.*\.$/u);
    expect(said[4]).toContain(language === 'de' ? '0,05' : '0.05');
  }
});

test('a field says what is wrong with it when it is refused, and nothing once it is changed', () => {
  class Input extends EventTarget {
    readonly min = '';
    readonly max = '';
    readonly title = '';
    said = '';
    isEmpty = true;
    readonly page: EventTarget;
    constructor(page: EventTarget) {
      super();
      this.page = page;
    }
    get validity() {
      return { valueMissing: this.isEmpty, customError: this.said !== '' };
    }
    setCustomValidity(said: string) {
      this.said = said;
    }
    fire(type: string) {
      const event = new Event(type);
      Object.defineProperty(event, 'target', { value: this });
      this.page.dispatchEvent(event);
    }
  }
  const page = new EventTarget();
  speakForFields(page as Document);
  const input = new Input(page);
  preferences.language = 'de';
  input.fire('invalid');
  expect(input.said).toBe(DICTIONARIES.de.form.missing);
  preferences.language = 'en';
  input.fire('invalid');
  expect(input.said).toBe(DICTIONARIES.en.form.missing);
  input.isEmpty = false;
  input.fire('input');
  expect(input.said).toBe('');
});
