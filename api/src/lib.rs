//! Types of every interface of Tread: REST bodies, zenoh payloads, key expressions, identifiers.
//!
//! This crate does no I/O, except [`startup`] and [`tunnel`], and depends on no other crate of
//! Tread. Both sides of every interface are built on it, so a change here is a change of the
//! protocol.
//!
//! * REST bodies: [`site`], [`terrain`], [`robot`], [`trajectory`], [`mission`], [`friction`],
//!   [`safety`], [`stop`], [`drive`], [`event`], [`identity`], [`webhook`], [`alert_kind`], [`page`], [`problem`].
//! * Compact binary form of the friction map: [`tile`].
//! * zenoh payloads: [`wire`], with the key expressions in [`keys`]; the TLS tunnel below them:
//!   [`tunnel`].
//!
//! Units are SI and are the suffix of a name (`_m`, `_m_s`, `_rad`). The frame of a site is metric
//! and right-handed, x east-like, y north-like; headings are counter-clockwise from x. An unknown
//! value is `null`, never a default. Integers stay below 2⁵³.

pub mod access;
pub mod alert_kind;
pub mod audit;
pub mod diagnosis;
pub mod drive;
pub mod enrolment;
pub mod event;
pub mod friction;
pub mod geometry;
pub mod identity;
pub mod ids;
pub mod keys;
pub mod link;
pub mod mission;
pub mod page;
pub mod problem;
pub mod release;
pub mod rights;
pub mod robot;
pub mod safety;
pub mod site;
pub mod start_policy;
pub mod startup;
pub mod stop;
pub mod terrain;
pub mod text;
pub mod tile;
pub mod trajectory;
pub mod tunnel;
pub mod webhook;
pub mod wire;
