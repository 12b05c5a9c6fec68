// Messages about failures: a sentence in the language of the page, and the detail of the server, which is English.
// A message is one string, so that code that only passes it on does not depend on its parts. Pure.

/** What is said later too, in the language that the page has then. */
export type Said = () => string;

/** Separates the sentence from the detail. */
const SEPARATOR = '\n';

/** Joins a sentence and the detail of the server to a message. */
export function withDetail(sentence: string, detail: string | null | undefined): string {
  return detail ? `${sentence}${SEPARATOR}${detail}` : sentence;
}

/** Splits a message into its sentence and its detail, which is null if there is none. */
export function splitMessage(text: string): { sentence: string; detail: string | null } {
  const at = text.indexOf(SEPARATOR);
  return at < 0 ? { sentence: text, detail: null } : { sentence: text.slice(0, at), detail: text.slice(at + SEPARATOR.length) };
}
