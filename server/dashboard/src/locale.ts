// Which language, numbers and units somebody expects whose browser asks for these locales. Pure.

export const LANGUAGES = ['en', 'de'] as const;
export type Language = (typeof LANGUAGES)[number];
export const SYSTEMS = ['metric', 'imperial'] as const;
export type System = (typeof SYSTEMS)[number];

/** Regions that measure in feet and pounds. */
const IMPERIAL_REGIONS: readonly string[] = ['US', 'LR', 'MM'];

const languageIn = (locale: string) => LANGUAGES.find((language) => locale.split('-')[0]?.toLowerCase() === language);

/** The first language that there is a dictionary for; English if there is none. */
export function languageOf(locales: readonly string[]): Language {
  return locales.map(languageIn).find((language) => language !== undefined) ?? 'en';
}

/** The browser's own locale of a language, such as `de-CH`, or the language itself. */
export function localeOf(language: Language, locales: readonly string[]): string {
  return locales.find((locale) => languageIn(locale) === language) ?? language;
}

/** The units of the first locale that names a region; metric if none does. */
export function systemOf(locales: readonly string[]): System {
  const regions = locales.flatMap((locale) => regionOf(locale) ?? []);
  return regions[0] !== undefined && IMPERIAL_REGIONS.includes(regions[0]) ? 'imperial' : 'metric';
}

function regionOf(locale: string): string | undefined {
  try {
    return new Intl.Locale(locale).region;
  } catch {
    // What is no locale names no region.
    return undefined;
  }
}
