//! A whole fleet under test: real server, real zenoh, a real database, simulated robots that run the
//! real agent, each in a process of its own, so that any of them can be killed or cut off.
//!
//! * [`fleet`]: starts and stops the processes.
//! * [`rest`]: speaks to the server as any client would.
//! * [`ports`]: where they listen.
//! * [`relay`]: a network between robot and server that can be cut.
//! * [`wait`]: waits for a state with a bound, and says what was seen last.
//! * [`chaos`]: runs in which things fail at random, from a seed of [`random`].
//! * [`database`]: the database of a fleet, of either engine.
//! * [`stored`]: what a database holds of measurements.
//! * [`scenario`]: fleets in a simulated time, from which figures are read.
//! * [`collector`]: receives traces as a collector does.
//! * [`damage`]: damages payloads.
//! * [`bare_router`]: a zenoh router without a server, to compare with.
//! * [`light_robot`]: robots without physics, for load.
//! * [`report`]: figures against their goals, as every report program prints them.
//! * [`markdown`]: the documentation, to be held against what there is.
//! * [`repository`]: its files.
//! * [`shell`]: the commands that it shows.

pub mod bare_router;
pub mod chaos;
pub mod collector;
pub mod damage;
pub mod database;
#[path = "../../server/tests/engine/mod.rs"]
mod engine;
pub mod fleet;
pub mod light_robot;
pub mod markdown;
pub mod ports;
pub mod process;
pub mod random;
pub mod relay;
pub mod report;
pub mod repository;
pub mod rest;
pub mod scenario;
pub mod shell;
pub mod stored;
pub mod wait;
