//! What the documentation says is held against what there is: where its links lead.

mod links;
