"""The paper's figures and its Table IV, made by this software."""
