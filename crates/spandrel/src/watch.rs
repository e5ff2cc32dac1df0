//! A view of a running system for people: parameters, alerts and services, in a terminal or as
//! plain lines.
//!
//! Messages and keys are the input. A screen, lines and acknowledgements are the output.
//!
//! - [`natural_name`], [`trail`], [`open_alert`], [`heard`]: state from the messages on the bus, without clock,
//!   network or terminal
//! - [`form`], [`view`]: state of the user's choices and input, which turns keys into actions
//! - [`wording`], [`estimate_bar`], [`wrap`]: numbers, intervals and sentences as text
//! - [`structure_panel`], [`nodes`], [`lists`], [`draw`]: the screen
//! - [`plain`]: the same content as lines, if there is no screen
//! - [`screen`], [`held_stderr`], [`shell`]: connection to the bus and the terminal

mod form;
mod heard;
mod natural_name;
mod open_alert;
mod trail;
mod view;

mod conditions;
mod draw;
mod estimate_bar;
mod judgements;
mod lists;
mod modes;
mod nodes;
mod plain;
mod structure_panel;
mod wording;
mod wrap;

mod held_stderr;
mod screen;
mod shell;

#[cfg(test)]
mod testing;

pub use held_stderr::HeldStderr;
pub use shell::show;
pub use view::Around;
