//! Many seeded storms over the missions of a server: loss, delay, doubling and reordering of
//! messages, restarts of both sides, cut links, and people who want this and that.
//!
//! `cargo run --release -p tread-server --example mission_storm -- 1000 1000` runs 1 000 seeds of
//! 1 000 steps each. It ends with code 1 at the first mission that is stuck, revived or doubled,
//! or that the two sides tell differently, and names the seed.

#[path = "../tests/storm/mod.rs"]
mod storm;

use std::process::ExitCode;

fn main() -> anyhow::Result<ExitCode> {
    let mut arguments = std::env::args().skip(1);
    let mut number = |or: u64| arguments.next().map_or(Ok(or), |text| text.parse());
    let (runs, steps, first) = (number(1_000)?, number(1_000)?, number(1)?);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let steps_each = usize::try_from(steps)?;
    let mut missions = 0;
    for seed in first..first + runs {
        match runtime.block_on(storm::run(seed, steps_each)) {
            Ok(count) => missions += count,
            Err(what) => {
                eprintln!("{what}");
                return Ok(ExitCode::FAILURE);
            }
        }
    }
    #[expect(clippy::print_stdout, reason = "it reports")]
    {
        println!(
            "{{\"runs\":{runs},\"steps\":{},\"missions\":{missions},\"stuck\":0,\"revived\":0}}",
            runs * steps
        );
    }
    Ok(ExitCode::SUCCESS)
}
