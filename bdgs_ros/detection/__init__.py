"""RgbdFrame to dynamic prior: who could be moving."""
