"""Renderers, their settings and colour scales."""

#: Devices that can be requested: a card if there is one; the processor; a card.
DEVICES = ("auto", "cpu", "cuda")

#: Help of a setting of one of them; {} is what computes on it.
DEVICE_HELP = (
    "What {} computes with: an NVIDIA card if there is one (auto), the processor, or a card (cuda). Cards are tested in"
    " a simulator only."
)
