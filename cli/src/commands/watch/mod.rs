//! `tread watch`: shows robots, missions and alerts live, from the server's event stream.
//!
//! In a terminal it draws a screen with the whole site; elsewhere, or with `--lines`, it prints a
//! line for each change; with `--json` the events themselves. An interrupted stream is resumed
//! where it ended, so that no event is missed; the interruption is reported.

mod feed;
mod lines;
mod picture;
mod screen;
mod site_state;
mod view;

use std::io::{self, IsTerminal as _};
use std::process::ExitCode;

use tokio::sync::mpsc;
use tread_api::event::{Event, StreamEnd};

use self::feed::{Feed, FeedMessage, MESSAGES_MAX};
use self::lines::Lines;
use self::screen::Screen;
use crate::args::WatchArguments;
use crate::client::Client;
use crate::output::{Output, json_line, line, print_note};
use crate::signals::ShutdownSignals;

pub(super) async fn run(
    arguments: &WatchArguments,
    client: &Client,
    output: Output,
) -> anyhow::Result<ExitCode> {
    let site = &arguments.connection.site;
    let feed = Feed::new(client, site, arguments.robot.as_ref());
    let (to, messages) = mpsc::channel(MESSAGES_MAX);
    let in_terminal = io::stdout().is_terminal() && io::stdin().is_terminal();
    let mut signals = ShutdownSignals::listen()?;
    let shown = async {
        if output.is_json() || arguments.lines || !in_terminal {
            print(messages, output).await
        } else {
            Screen::new(arguments, client).run(messages).await
        }
    };
    tokio::select! {
        ended = feed.run(to) => ended,
        ended = shown => ended,
        () = signals.next() => Ok(()),
    }?;
    Ok(ExitCode::SUCCESS)
}

/// Prints news until the sender is dropped.
async fn print(mut messages: mpsc::Receiver<FeedMessage>, output: Output) -> anyhow::Result<()> {
    let mut lines = Lines::default();
    while let Some(message) = messages.recv().await {
        match message {
            FeedMessage::Opened => {}
            FeedMessage::Lost(why) => print_note(&format!("{why}; trying again")),
            FeedMessage::Event(event) => {
                if let Event::End(end) = &*event {
                    print_note(ended(*end));
                }
                if output.is_json() {
                    json_line(&event)?;
                } else if let Some(text) = lines.take(&event) {
                    line(&text)?;
                }
            }
        }
    }
    Ok(())
}

/// Returns the reason why the server ended the stream, for people.
fn ended(end: StreamEnd) -> &'static str {
    match end {
        StreamEnd::TooSlow => "the server closed the stream, because it was read too slowly",
        StreamEnd::Stopping => "the server stops",
    }
}
