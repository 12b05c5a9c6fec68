// What the page says of a failure: a sentence in its language, and after it what the server adds, which is English.
// Both are one text, so that whoever passes it on needs to know nothing of its parts. Pure.

/** Between the sentence and what the server adds. */
const MARK = '\n';

/** A sentence with what the server adds to it. */
export function withDetail(sentence: string, detail: string | null | undefined): string {
  return detail ? `${sentence}${MARK}${detail}` : sentence;
}

/** The sentence, and what the server adds; null where it adds nothing. */
export function parted(text: string): { sentence: string; detail: string | null } {
  const at = text.indexOf(MARK);
  return at < 0 ? { sentence: text, detail: null } : { sentence: text.slice(0, at), detail: text.slice(at + MARK.length) };
}
