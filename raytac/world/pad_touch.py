class PadTouch: pass
