//! The server as its neighbours see it: real HTTP, real SQLite, real zenoh, and robots that are
//! played by the test.

#[cfg(test)]
mod alerts;
#[cfg(test)]
mod archive;
#[cfg(test)]
mod as_of;
#[cfg(test)]
mod backups;
#[cfg(test)]
mod bad_input;
#[cfg(test)]
mod bounds;
#[cfg(test)]
mod clock;
#[cfg(test)]
mod conditions;
#[cfg(test)]
mod control;
#[cfg(test)]
mod copies;
#[cfg(test)]
mod drive;
#[cfg(test)]
mod dry_run;
#[cfg(test)]
#[path = "../engine/mod.rs"]
mod engine;
#[cfg(test)]
mod events;
#[cfg(test)]
mod exports;
#[cfg(test)]
mod first_steps;
#[cfg(test)]
mod flood;
#[cfg(test)]
mod friction;
#[cfg(test)]
mod geofence;
#[cfg(test)]
mod harness;
#[cfg(test)]
mod identity;
#[cfg(test)]
mod ingest;
#[cfg(test)]
mod live;
#[cfg(test)]
mod map;
#[cfg(test)]
mod map_blocks;
#[cfg(test)]
mod metrics;
#[cfg(test)]
mod missions;
#[cfg(test)]
mod network;
#[cfg(test)]
mod oidc;
#[cfg(test)]
mod openapi;
#[cfg(test)]
mod page;
#[cfg(test)]
mod pictures;
#[cfg(test)]
#[path = "../../../tests/src/ports.rs"]
#[expect(
    unreachable_pub,
    reason = "it is a public module of the crate of all tests"
)]
mod ports;
#[cfg(test)]
mod postgres;
#[cfg(test)]
mod program;
#[cfg(test)]
mod releases;
#[cfg(test)]
mod republish;
#[cfg(test)]
mod request_bodies;
#[cfg(test)]
mod resources;
#[cfg(test)]
mod restoration;
#[cfg(test)]
mod retention;
#[cfg(test)]
mod robot;
#[cfg(test)]
mod robots;
#[cfg(test)]
mod service_manager;
#[cfg(test)]
mod slow_client;
#[cfg(test)]
mod stops;
#[cfg(test)]
mod storage;
#[cfg(test)]
mod watched;
#[cfg(test)]
mod webhooks;
