//! Questions in a terminal. Each shows its default, and Enter accepts it. An invalid answer gets an
//! explanation, and the question is repeated.

use std::fmt::Display;
use std::io::{BufRead, Write};
use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context as _, bail};

use super::choices::{Choices, Defaults, check_files, check_name, files, tls_default, web};
use super::{SetupArgs, TlsChoice};
use crate::config::{SITE_DEFAULT, TlsFiles};

/// Maximum number of answers to one question.
const TRIES_MAX: u32 = 5;
/// Maximum number of bytes of an answer.
const ANSWER_BYTES_MAX: u64 = 4_096;

/// Answer to a question that Enter stands for.
#[derive(Clone, Copy)]
struct DefaultAnswer<'text>(&'text str);

/// A person who answers.
pub(super) struct Questions<'a> {
    input: &'a mut dyn BufRead,
    output: &'a mut dyn Write,
}

impl<'a> Questions<'a> {
    pub(super) fn new(input: &'a mut dyn BufRead, output: &'a mut dyn Write) -> Self {
        Self { input, output }
    }

    fn print_line(&mut self, text: &str) -> anyhow::Result<()> {
        writeln!(self.output, "{text}").context("cannot print")
    }

    /// Repeats the question until `read` accepts the answer. An empty answer means the default.
    ///
    /// # Errors
    /// Nobody answers, or no answer is valid.
    fn ask<T>(
        &mut self,
        question: &str,
        DefaultAnswer(default): DefaultAnswer<'_>,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> anyhow::Result<T> {
        for _ in 0..TRIES_MAX {
            write!(self.output, "{question} [{default}]: ").context("cannot print")?;
            self.output.flush().context("cannot print")?;
            let mut line = String::new();
            let mut input = std::io::Read::take(&mut *self.input, ANSWER_BYTES_MAX);
            let count = input
                .read_line(&mut line)
                .context("cannot read the answer")?;
            if count == 0 {
                bail!("nobody answers: give --yes and flags instead; nothing was written");
            }
            let answer = match line.trim() {
                "" => default,
                answer => answer,
            };
            match read(answer) {
                Ok(value) => return Ok(value),
                Err(why) => self.print_line(&format!("  {why}"))?,
            }
        }
        bail!("no answer to `{question}` could be taken; nothing was written")
    }
}

fn parsed<T: FromStr<Err: Display>>(text: &str) -> Result<T, String> {
    text.parse()
        .map_err(|why| format!("`{text}` cannot be taken: {why}"))
}

#[expect(
    clippy::unnecessary_wraps,
    reason = "every answer is read by such a function"
)]
fn path(text: &str) -> Result<PathBuf, String> {
    Ok(PathBuf::from(text))
}

fn names(text: &str) -> Result<Vec<String>, String> {
    let names = text
        .split([',', ' '])
        .map(str::trim)
        .filter(|name| !name.is_empty());
    let names: Vec<String> = names.map(str::to_owned).collect();
    names.iter().try_for_each(|name| check_name(name))?;
    if names.is_empty() {
        return Err("at least one name or address is needed".to_owned());
    }
    Ok(names)
}

fn parse_tls_choice(text: &str) -> Result<TlsChoice, String> {
    match text {
        "1" => Ok(TlsChoice::Authority),
        "2" => Ok(TlsChoice::Files),
        "3" => Ok(TlsChoice::Proxy),
        "4" => Ok(TlsChoice::Loopback),
        other => Err(format!("`{other}` is none of 1, 2, 3, 4")),
    }
}

fn is_yes(text: &str) -> Result<bool, String> {
    match text.to_ascii_lowercase().as_str() {
        "y" | "yes" => Ok(true),
        "n" | "no" => Ok(false),
        other => Err(format!("`{other}` is neither yes nor no")),
    }
}

/// Asks for all choices that no flag gives.
///
/// # Errors
/// Nobody answers, or the answers contradict each other.
pub(super) fn ask(
    args: &SetupArgs,
    defaults: &Defaults,
    questions: &mut Questions<'_>,
) -> anyhow::Result<Choices> {
    questions.print_line(
        "This writes a configuration for a Tread server. Enter takes what is in brackets.",
    )?;
    let config = questions.ask(
        "Configuration file",
        DefaultAnswer(&defaults.config.display().to_string()),
        path,
    )?;
    let data_dir = if let Some(folder) = &args.data_dir {
        folder.clone()
    } else {
        let default = defaults.data_dir(&config);
        questions.ask(
            "Folder of database and authority",
            DefaultAnswer(&default.display().to_string()),
            path,
        )?
    };
    let site = match &args.site {
        Some(site) => site.clone(),
        None => questions.ask("Site", DefaultAnswer(SITE_DEFAULT), parsed)?,
    };
    let tls = match args.tls {
        Some(tls) => tls,
        None if args.tls_certificate.is_some() => tls_default(args),
        None => {
            questions.print_line(
                "How do people and programs reach the REST API?\n  \
                 1  by TLS, with a certificate of the fleet's own authority\n  \
                 2  by TLS, with certificate and key from files\n  \
                 3  by a proxy on this machine that ends TLS\n  \
                 4  from this machine alone, without TLS",
            )?;
            questions.ask("One of 1 to 4", DefaultAnswer("1"), parse_tls_choice)?
        }
    };
    let names = if tls == TlsChoice::Loopback || !args.names.is_empty() {
        args.names.clone()
    } else {
        let default = defaults.host_name.as_deref().unwrap_or("");
        questions.ask(
            "Names and addresses by which others find this server, separated by commas",
            DefaultAnswer(default),
            names,
        )?
    };
    let files = match files(args) {
        Some(files) => Some(files),
        None if tls == TlsChoice::Files => Some(ask_files(&names, questions)?),
        None => None,
    };
    let [http, zenoh] = tls.addresses();
    let http = match args.http {
        Some(http) => http,
        None => questions.ask(
            "Address of the REST API",
            DefaultAnswer(&http.to_string()),
            parsed,
        )?,
    };
    let zenoh = match args.zenoh {
        Some(zenoh) => zenoh,
        None => questions.ask(
            "Address that robots connect to",
            DefaultAnswer(&zenoh.to_string()),
            parsed,
        )?,
    };
    let token_file = questions.ask(
        "File for the admin's token",
        DefaultAnswer(&defaults.token_file(&config).display().to_string()),
        path,
    )?;
    let choices = Choices {
        config,
        data_dir,
        token_file,
        site,
        names,
        http,
        zenoh,
        web: web(tls, files)?,
    };
    choices.check()?;
    questions.print_line(&format!("\n{}", super::text::toml(&choices)))?;
    if !questions.ask("Write this configuration?", DefaultAnswer("yes"), is_yes)? {
        bail!("nothing was written");
    }
    Ok(choices)
}

/// Asks for certificate and key until they are usable.
fn ask_files(names: &[String], questions: &mut Questions<'_>) -> anyhow::Result<TlsFiles> {
    for _ in 0..TRIES_MAX {
        let files = TlsFiles {
            certificate: questions.ask(
                "Certificate, PEM, with its intermediate certificates",
                DefaultAnswer("/etc/tread/fullchain.pem"),
                path,
            )?,
            key: questions.ask(
                "Its private key, PEM",
                DefaultAnswer("/etc/tread/key.pem"),
                path,
            )?,
        };
        match check_files(&files, names) {
            Ok(()) => return Ok(files),
            Err(why) => questions.print_line(&format!("  {why:#}"))?,
        }
    }
    bail!("no certificate could be used; nothing was written")
}
