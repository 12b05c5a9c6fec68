//! The real command line against a real server and a real agent with a simulated base.

#![expect(
    clippy::unwrap_used,
    reason = "what the helpers of a test cannot do fails the test"
)]

mod authority;
mod demo;
mod documentation;
mod drive;
mod first_steps;
mod manual;
mod operator;
mod terminal;
mod waiting;
mod watch;
mod webhooks;
mod yard;
