//! The commands of a shell script, as far as documentation uses a shell: quotes, comments, pipes,
//! redirections, and commands within `$(…)`. Nothing is expanded.

/// A command with its arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShellCommand {
    /// Its line in the script, from 1.
    pub line: usize,
    /// Its words, without their quotes.
    pub words: Vec<String>,
}

/// What separates commands.
const SEPARATORS: [char; 5] = ['\n', ';', '|', '&', '}'];

/// The commands of a script, those within `$(…)` after the one that holds them.
pub fn commands(script: &str) -> Vec<ShellCommand> {
    let mut reader = Reader {
        line: 1,
        ..Reader::default()
    };
    let mut letters = script.chars().peekable();
    while let Some(letter) = letters.next() {
        match (reader.quote, letter) {
            (Some(quote), letter) if letter == quote => reader.quote = None,
            (None, '"' | '\'') => {
                reader.quote = Some(letter);
                reader.word.get_or_insert_default();
            }
            (None | Some('"'), '\\') => {
                if let Some(escaped) = letters.next() {
                    match escaped {
                        '\n' => reader.line += 1,
                        escaped => reader.push(escaped),
                    }
                }
            }
            (None | Some('"'), '$') if letters.peek() == Some(&'(') => {
                letters.next();
                let mut depth = 1;
                let within: String = letters
                    .by_ref()
                    .take_while(|letter| {
                        depth += match letter {
                            '(' => 1,
                            ')' => -1,
                            _ => 0,
                        };
                        depth > 0
                    })
                    .collect();
                let line = reader.line;
                let nested = commands(&within).into_iter().map(|typed| ShellCommand {
                    line: line + typed.line - 1,
                    ..typed
                });
                reader.nested.extend(nested);
                reader.line += within.matches('\n').count();
                reader.push('x');
            }
            (None, '#') if reader.word.is_none() => {
                while letters.next_if(|&letter| letter != '\n').is_some() {}
            }
            (None, separator) if SEPARATORS.contains(&separator) => {
                reader.end_command();
                reader.line += usize::from(separator == '\n');
            }
            (None, '>' | '<') => {
                reader.end_word();
                reader.is_redirected = true;
            }
            (None, letter) if letter.is_whitespace() => reader.end_word(),
            (_, letter) => {
                reader.line += usize::from(letter == '\n');
                reader.push(letter);
            }
        }
    }
    reader.end_command();
    reader.commands
}

#[derive(Debug, Default)]
struct Reader {
    line: usize,
    quote: Option<char>,
    word: Option<String>,
    words: Vec<String>,
    /// The next word is the file of a redirection.
    is_redirected: bool,
    begin: Option<usize>,
    nested: Vec<ShellCommand>,
    commands: Vec<ShellCommand>,
}

impl Reader {
    fn push(&mut self, letter: char) {
        self.begin.get_or_insert(self.line);
        self.word.get_or_insert_default().push(letter);
    }

    fn end_word(&mut self) {
        let Some(word) = self.word.take() else { return };
        if !std::mem::take(&mut self.is_redirected) {
            self.words.push(word);
        }
    }

    fn end_command(&mut self) {
        self.end_word();
        self.is_redirected = false;
        let begin = self.begin.take().unwrap_or(self.line);
        let words = std::mem::take(&mut self.words);
        if !words.is_empty() {
            self.commands.push(ShellCommand { line: begin, words });
        }
        self.commands.append(&mut self.nested);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_found_as_a_shell_finds_them() {
        let script = "a \"b c\" 'd\ne' > f   # not \"this\n\
                      g | h --i=$(j \"k\") && l\nm \\\n  n\no \"p $(q r)\" < s\n";
        let found: Vec<(usize, String)> = commands(script)
            .into_iter()
            .map(|typed| (typed.line, typed.words.join("_")))
            .collect();
        let expected = [
            (1, "a_b c_d\ne"),
            (3, "g"),
            (3, "h_--i=x"),
            (3, "j_k"),
            (3, "l"),
            (4, "m_n"),
            (6, "o_p x"),
            (6, "q_r"),
        ];
        let expected = expected.map(|(line, words)| (line, words.to_owned()));
        assert_eq!(found, expected);
    }
}
