//! Every word that crosses the network: REST bodies, zenoh payloads, key expressions, identifiers.
//!
//! This crate does no I/O, [`startup`] aside, and knows no other part of Tread. Both sides of every wire build on it,
//! so a change here is a change of the protocol.
//!
//! * REST shapes: [`site`], [`terrain`], [`robot`], [`trajectory`], [`mission`], [`friction`],
//!   [`safety`], [`stop`], [`drive`], [`event`], [`identity`], [`page`], [`problem`].
//! * The friction map as compact binary: [`tile`].
//! * zenoh shapes: [`wire`], with the key expressions in [`keys`]; the TLS around it: [`tunnel`].
//!
//! Units are SI and stand last in a name (`_m`, `_m_s`, `_rad`). A site's frame is metric and
//! right-handed, x east-like, y north-like; headings are counter-clockwise from x. A value that is
//! not known is `null`, never a default. Integers stay below 2⁵³.

pub mod access;
pub mod audit;
pub mod drive;
pub mod enrolment;
pub mod event;
pub mod friction;
pub mod geometry;
pub mod identity;
pub mod ids;
pub mod keys;
pub mod mission;
pub mod page;
pub mod problem;
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
pub mod wire;
