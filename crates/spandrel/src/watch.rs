//! Shows a running system to people: parameters, alerts and services, in a terminal or as plain lines.
//!
//! Messages and keys go in; a screen, lines and acknowledgements come out.
//!
//! - [`natural_name`], [`trail`], [`heard`]: what has been heard on the bus, without clock, network or terminal
//! - [`form`], [`view`]: what the person has chosen and typed; keys in, actions out
//! - [`wording`], [`estimate_bar`], [`wrap`]: numbers, intervals and sentences as text
//! - [`structure_panel`], [`nodes`], [`lists`], [`draw`]: the screen
//! - [`plain`]: the same as lines, where there is no screen
//! - [`topics`], [`listen`], [`screen`], [`held_stderr`], [`shell`]: joins it to bus and terminal

mod form;
mod heard;
mod natural_name;
mod trail;
mod view;

mod draw;
mod estimate_bar;
mod lists;
mod nodes;
mod plain;
mod structure_panel;
mod wording;
mod wrap;

mod held_stderr;
mod listen;
mod screen;
mod shell;
mod topics;

#[cfg(test)]
mod testing;

pub use held_stderr::HeldStderr;
pub use shell::show;
pub use view::Around;
